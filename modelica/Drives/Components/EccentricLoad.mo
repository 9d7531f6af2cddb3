within Drives.Components;
model EccentricLoad "Inertia with an eccentric mass: the torque -m g r sin(phi) acts on it"
  parameter Types.Inertia J(start = 1) "Moment of inertia, eccentric mass included";
  parameter Types.Torque mgr(start = 25) "Weight times eccentricity, the largest load torque";
  Interfaces.Flange_a flange_a "Flange of the shaft";
  Types.Angle phi(start = 0, stateSelect = StateSelect.prefer) "Absolute angle, 0 with the mass hanging down";
  Types.AngularVelocity w(start = 0, nominal = 1, stateSelect = StateSelect.prefer) "Absolute angular velocity";
  Types.AngularAcceleration a(start = 0) "Absolute angular acceleration";
equation
  phi = flange_a.phi;
  w = der(phi);
  a = der(w);
  J*a = flange_a.tau - mgr*sin(phi);
end EccentricLoad;
