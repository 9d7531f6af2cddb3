model InvertedPendulum "A pendulum that a torque balances: it falls over when its torque is played back"
  parameter Real J(unit = "kg.m2") = 0.02 "Inertia about the pivot";
  parameter Real mgl(unit = "N.m") = 0.6 "Weight times distance from the pivot";
  parameter Real d(unit = "N.m.s/rad") = 0.01 "Viscous friction";
  input Real tau(unit = "N.m") "Torque at the pivot";
  output Real phi(start = 0, fixed = true, unit = "rad") "Angle from the upright";
  Real w(start = 0, fixed = true, unit = "rad/s") "Speed";
equation
  der(phi) = w;
  J * der(w) = tau + mgl * sin(phi) - d * w;
end InvertedPendulum;
