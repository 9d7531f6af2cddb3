within Drives.Translational;
model ForceMotor "Force proportional to the control signal"
  extends PartialForceMotor;
equation
  f = gtau*u;
end ForceMotor;
