model InverseJoint "The torque that a measured motion takes"
  parameter Real J(unit = "kg.m2") = 0.5 "Inertia";
  parameter Real d(unit = "N.m.s/rad") = 1 "Viscous friction";
  parameter Real f(unit = "N.m") = 1 "Coulomb friction";
  input Real w(unit = "rad/s") "Speed";
  input Real a(unit = "rad/s2") "Acceleration";
  output Real tau(unit = "N.m") "Torque";
equation
  tau = J * a + d * w + f * tanh(w / 0.05);
end InverseJoint;
