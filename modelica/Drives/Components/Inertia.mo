within Drives.Components;
model Inertia "Rigid body with inertia between two flanges"
  extends Interfaces.PartialTwoFlanges;
  parameter Types.Inertia J(start = 1) "Moment of inertia";
  Types.Angle phi(start = 0, stateSelect = StateSelect.prefer) "Absolute angle";
  Types.AngularVelocity w(start = 0, nominal = 1, stateSelect = StateSelect.prefer) "Absolute angular velocity";
  Types.AngularAcceleration a(start = 0) "Absolute angular acceleration";
equation
  phi = flange_a.phi;
  phi = flange_b.phi;
  w = der(phi);
  a = der(w);
  J*a = flange_a.tau + flange_b.tau;
end Inertia;
