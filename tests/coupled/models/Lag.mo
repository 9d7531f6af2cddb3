model Lag "First-order lag with feedthrough d"
  parameter Real T(unit = "s") = 0.1;
  parameter Real d = 0;
  parameter Real x_start = 1;
  input Real u(start = 0, unit = "N.m");
  output Real y(unit = "N.m");
  output Real x(start = x_start, fixed = true, unit = "N.m");
equation
  T*der(x) = u - x;
  y = x + d*u;
end Lag;
