within Pendulum.Components;
model Motor "Torque as demanded, up to a limit"
  import Drives.Types;
  parameter Real gain(unit = "1") = 1 "Torque made over torque demanded";
  parameter Types.Torque tau_max(min = 0) = 3.7 "Largest torque";
  Drives.Interfaces.RealInput u(unit = "N.m") "Demanded torque";
  Drives.Interfaces.Flange_b flange "Rotor";
  Types.Torque tau "Torque on the rotor";
equation
  flange.tau = -tau;
  tau = gain*noEvent(max(-tau_max, min(tau_max, u)));
end Motor;
