model Wave "A sine"
  parameter Real a = 1;
  parameter Real w(unit = "rad/s") = 5;
  output Real y;
equation
  y = a*sin(w*time);
end Wave;
