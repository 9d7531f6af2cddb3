within Drives.Interfaces;
connector Flange_b "Rotational flange, as in Modelica.Mechanics.Rotational.Interfaces"
  Types.Angle phi "Absolute rotation angle of the flange";
  flow Types.Torque tau "Cut torque in the flange, positive into the component";
end Flange_b;
