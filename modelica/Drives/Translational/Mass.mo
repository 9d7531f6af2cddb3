within Drives.Translational;
model Mass "Sliding mass"
  extends PartialMass;
equation
  M*a = flange_a.f + flange_b.f;
end Mass;
