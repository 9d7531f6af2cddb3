within Pendulum.Components;
partial model PartialEncoder "Encoder of the joint; how it reads is left open"
  import Drives.Types;
  parameter Types.Angle offset = 0 "Reading at the angle 0";
  Drives.Interfaces.RealInput phi(unit = "rad") "Angle of the arm";
  Drives.Interfaces.RealInput tau(unit = "N.m") "Torque of the load at the joint";
  Drives.Interfaces.RealOutput q(unit = "rad") "Reading";
end PartialEncoder;
