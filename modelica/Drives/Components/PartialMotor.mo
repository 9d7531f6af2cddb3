within Drives.Components;
partial model PartialMotor "Torque between stator and rotor; its dependence on the current is left open"
  parameter Types.TorqueConstant K_m(start = 0.7) "Torque constant";
  Interfaces.RealInput i(unit = "A") "Current";
  Interfaces.Flange_a stator "Stator";
  Interfaces.Flange_b rotor "Rotor";
  Types.Torque tau "Torque on the rotor";
equation
  rotor.tau = -tau;
  stator.tau = tau;
end PartialMotor;
