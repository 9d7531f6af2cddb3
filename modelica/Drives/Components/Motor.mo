within Drives.Components;
model Motor "Torque proportional to current between stator and rotor"
  parameter Types.TorqueConstant K_m(start = 0.7) "Torque constant";
  Interfaces.RealInput i(unit = "A") "Current";
  Interfaces.Flange_a stator "Stator";
  Interfaces.Flange_b rotor "Rotor";
  Types.Torque tau "Torque on the rotor";
equation
  rotor.tau = -tau;
  stator.tau = tau;
  tau = K_m*i;
end Motor;
