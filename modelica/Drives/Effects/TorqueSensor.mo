within Drives.Effects;
model TorqueSensor "Torque sensor with offset, wrong gain and lag"
  extends Components.PartialTorqueSensor;
  parameter Types.Torque offset = 0 "Offset of the reading";
  parameter Real gain(unit = "1") = 1 "Gain of the reading";
  parameter Types.Time lag(min = 0) = 0 "Time constant of the reading";
  Lag filter(T = lag) "Lag of the reading";
equation
  filter.u = tau;
  tau_sensor = gain*filter.y + offset;
end TorqueSensor;
