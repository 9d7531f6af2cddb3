within Drives.Translational;
model ForceMotor "Force proportional to the control signal"
  parameter Real gtau(unit = "N/V", start = 35.15) "Force per control signal";
  Interfaces.RealInput u(unit = "V") "Control signal";
  Interfaces.TranslationalFlange_b flange "Driven flange";
  Types.Force f "Force on the driven flange";
equation
  f = gtau*u;
  flange.f = -f;
end ForceMotor;
