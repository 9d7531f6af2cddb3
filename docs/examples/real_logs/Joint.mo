model Joint "Wrist joint of a robot: torque command in, speed out"
  parameter Real J(unit="kg.m2", min=1e-6) = 0.1389 "Inertia";
  parameter Real d(unit="N.m.s/rad", min=0) = 0.5 "Viscous friction";
  input Real tau(unit="N.m") "Torque command";
  output Real w(unit="rad/s", start=0, fixed=true) "Speed";
equation
  J*der(w) = tau - d*w;
end Joint;
