within Drives.Translational;
partial model PartialForceMotor "Force on a flange; how it follows from the control signal is left open"
  parameter Real gtau(unit = "N/V", start = 35.15) "Force per control signal";
  Interfaces.RealInput u(unit = "V") "Control signal";
  Interfaces.TranslationalFlange_b flange "Driven flange";
  Types.Force f "Force on the driven flange";
equation
  flange.f = -f;
end PartialForceMotor;
