within Drives.Interfaces;
partial model PartialCompliant "Massless element between two flanges; its torque depends on the relative motion"
  extends PartialTwoFlanges;
  Types.Angle phi_rel(start = 0) "Relative angle, flange_b.phi - flange_a.phi";
  Types.AngularVelocity w_rel(start = 0) "Relative angular velocity, der(phi_rel)";
  Types.Torque tau "Torque in the element";
equation
  phi_rel = flange_b.phi - flange_a.phi;
  w_rel = der(phi_rel);
  flange_b.tau = tau;
  flange_a.tau = -tau;
end PartialCompliant;
