within Drives.Components;
model Torque "Given torque on a flange, from the outside"
  Interfaces.RealInput tau(unit = "N.m") "Torque on the flange";
  Interfaces.Flange_b flange "Driven flange";
equation
  flange.tau = -tau;
end Torque;
