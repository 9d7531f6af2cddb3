within Drives.Setups;
model EccentricLoad "Eccentric mass on the output shaft, rotor speed controlled"
  extends PartialSpeedControlled(J_L = 0.5);
  parameter Types.Torque mgr = 25 "Weight times eccentricity of the load, the largest load torque";
  output Types.Angle phi_load "Angle of the load, 0 with the mass hanging down";
  Components.EccentricLoad load(J = J_L, mgr = mgr, phi(start = phi_load_start, fixed = true),
    w(start = w_motor_start/n, fixed = true)) "Eccentric load";
equation
  connect(flexspline.flange_b, load.flange_a);
  phi_load = load.phi;
  annotation(experiment(StartTime = 0, StopTime = 50, Interval = 1e-2, Tolerance = 1e-6));
end EccentricLoad;
