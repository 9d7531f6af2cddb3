model MyDrive "Motor with friction and a current as its input"
  parameter Real J(unit = "kg.m2", min = 1e-6) = 0.01 "Inertia";
  parameter Real d(unit = "N.m.s/rad", min = 0) = 0.05 "Viscous friction";
  parameter Real K_m(unit = "N.m/A") = 0.1 "Torque constant";
  input Real i(unit = "A") "Current";
  output Real w(unit = "rad/s", start = 0, fixed = true) "Speed";
equation
  J*der(w) = K_m*i - d*w;
  annotation(experiment(StopTime = 1, Interval = 0.01));
end MyDrive;
