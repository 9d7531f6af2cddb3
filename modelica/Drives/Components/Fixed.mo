within Drives.Components;
model Fixed "Flange fixed at an angle"
  parameter Types.Angle phi0 = 0 "Angle of the flange";
  Interfaces.Flange_b flange "Fixed flange";
equation
  flange.phi = phi0;
end Fixed;
