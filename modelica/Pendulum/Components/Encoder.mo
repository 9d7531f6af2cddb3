within Pendulum.Components;
model Encoder "Encoder with an offset"
  import Drives.Types;
  parameter Types.Angle offset = 0 "Reading at the angle 0";
  Drives.Interfaces.RealInput phi(unit = "rad") "Angle of the arm";
  Drives.Interfaces.RealOutput q(unit = "rad") "Reading";
equation
  q = phi + offset;
end Encoder;
