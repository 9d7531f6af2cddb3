within Drives.Translational;
model Mass "Sliding mass"
  parameter Types.Mass M(start = 1) "Mass";
  Interfaces.TranslationalFlange_a flange_a "Left flange";
  Interfaces.TranslationalFlange_b flange_b "Right flange";
  Types.Position s(start = 0, stateSelect = StateSelect.prefer) "Absolute position";
  Types.Velocity v(start = 0, stateSelect = StateSelect.prefer) "Absolute velocity";
  Types.Acceleration a(start = 0) "Absolute acceleration";
equation
  s = flange_a.s;
  s = flange_b.s;
  v = der(s);
  a = der(v);
  M*a = flange_a.f + flange_b.f;
end Mass;
