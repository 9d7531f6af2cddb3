model Gain "y = k*u + b, without delay"
  parameter Real k = 1;
  parameter Real b = 0;
  input Real u(start = 0);
  output Real y;
equation
  y = k*u + b;
end Gain;
