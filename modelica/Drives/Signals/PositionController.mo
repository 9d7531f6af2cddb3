within Drives.Signals;
block PositionController "Position cascade: proportional position loop around a proportional speed loop"
  parameter Types.Rate kp(start = 160.18) "Gain of the position loop";
  parameter Real kv(unit = "V.s/m", start = 243.45) "Gain of the speed loop";
  parameter Types.Time t_v(min = 1e-6, start = 1e-3) "Lag of the velocity, which is derived from the position";
  parameter Types.Voltage u_max(min = 0, start = 10) "Largest control signal";
  parameter Types.Position s_start = 0 "Start value of the lagged position";
  Interfaces.RealInput s_ref(unit = "m") "Reference position";
  Interfaces.RealInput s(unit = "m") "Measured position";
  Interfaces.RealInput u_add(unit = "V") "Signal added to the control signal before the limit";
  Interfaces.RealOutput u(unit = "V") "Control signal";
  Types.Position s_lagged(start = s_start, fixed = true) "Position behind the lag";
  Types.Velocity v "Derived velocity";
equation
  der(s_lagged) = v;
  v = (s - s_lagged)/t_v;
  u = noEvent(max(-u_max, min(u_max, kp*kv*(s_ref - s) - kv*v + u_add)));
end PositionController;
