model Steady "A first-order lag that begins at rest"
  parameter Real T(unit = "s") = 0.1;
  input Real u(start = 0);
  output Real y;
initial equation
  der(y) = 0;
equation
  T*der(y) = u - y - y^3;
end Steady;
