model Threshold "Counts up while the input is above a level, else down"
  parameter Real level = 0.3;
  input Real u(start = 0);
  output Real y(start = 0, fixed = true);
equation
  der(y) = if u > level then 1 else -2;
end Threshold;
