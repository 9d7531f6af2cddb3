within Drives.Setups;
model FreeShaft "Output shaft free, rotor speed controlled"
  extends PartialSpeedControlled;
  Components.Inertia load(J = J_L, phi(start = phi_load_start, fixed = true), w(start = w_motor_start/n, fixed = true)) "Load";
equation
  connect(flexspline.flange_b, load.flange_a);
  annotation(experiment(StartTime = 0, StopTime = 10, Interval = 2e-3, Tolerance = 1e-6));
end FreeShaft;
