within Drives.Effects;
block Delay "Dead time, as the Pade approximation (1, 2); passes its input through at dead time 0"
  parameter Types.Time T(min = 0) = 0 "Dead time";
  Interfaces.RealInput u "Input";
  Interfaces.RealOutput y "Output";
  Real x(start = 0, fixed = true) "First state of the approximation";
  Real v(start = 0, fixed = true) "T der(x)";
equation
  der(x) = noEvent(if T > 0 then v/max(T, 1e-6) else 0.0);
  der(v) = noEvent(if T > 0 then (u - 6*x - 4*v)/max(T, 1e-6) else 0.0);
  y = noEvent(if T > 0 then 6*x - 2*v else u);
end Delay;
