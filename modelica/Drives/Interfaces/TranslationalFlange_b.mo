within Drives.Interfaces;
connector TranslationalFlange_b "Translational flange, as in Modelica.Mechanics.Translational.Interfaces"
  Types.Position s "Absolute position of the flange";
  flow Types.Force f "Cut force in the flange, positive into the component";
end TranslationalFlange_b;
