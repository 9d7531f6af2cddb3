model Motors "Two coupled servo motors: torque command in, speed out"
  parameter Real J(unit="kg.m2", min=1e-7) = 1.2e-4 "Inertia";
  parameter Real B(unit="N.m.s/rad", min=0) = 7.03e-5 "Viscous friction";
  parameter Real T_c(unit="N.m", min=0) = 0.01 "Coulomb friction";
  constant Real narrow(unit="rad/s") = 1 "Speed over which the friction changes its sign";
  input Real tau(unit="N.m") "Torque command";
  output Real w(unit="rad/s", start=0, fixed=true) "Speed";
equation
  J*der(w) = tau - B*w - T_c*tanh(w/narrow);
end Motors;
