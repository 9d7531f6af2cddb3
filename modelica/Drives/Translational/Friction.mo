within Drives.Translational;
model Friction "Viscous and Coulomb friction against the ground, and a constant force"
  extends PartialFriction;
equation
  forward = Fc;
  backward = -Fc;
  fluid = Fv*v;
end Friction;
