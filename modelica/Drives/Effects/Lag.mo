within Drives.Effects;
block Lag "First-order lag; passes its input through at time constant 0"
  parameter Types.Time T(min = 0) = 0 "Time constant";
  Interfaces.RealInput u "Input";
  Interfaces.RealOutput y "Output";
  Real x(start = 0, fixed = true) "Lagged input";
equation
  der(x) = noEvent(if T > 0 then (u - x)/max(T, 1e-6) else 0.0);
  y = noEvent(if T > 0 then x else u);
end Lag;
