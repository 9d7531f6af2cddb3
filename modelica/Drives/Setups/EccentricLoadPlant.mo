within Drives.Setups;
model EccentricLoadPlant "Eccentric mass on the output shaft, driven by a current: EccentricLoad without its controller"
  extends PartialActuator(J_L = 0.5,
    rotor(phi(start = n*phi_load_start, fixed = true), w(start = w_motor_start, fixed = true)));
  parameter Types.Torque mgr = 25 "Weight times eccentricity of the load, the largest load torque";
  parameter Types.Angle phi_load_start = 0 "Start angle of the load; the Flexspline starts relaxed";
  parameter Types.AngularVelocity w_motor_start = 0 "Start speed of the rotor; the load starts at 1/n of it";
  input Types.Current i "Current of the motor";
  output Types.Angle phi_load "Angle of the load, 0 with the mass hanging down";
  Components.EccentricLoad load(J = J_L, mgr = mgr, phi(start = phi_load_start, fixed = true),
    w(start = w_motor_start/n, fixed = true)) "Eccentric load";
equation
  motor.i = i;
  connect(flexspline.flange_b, load.flange_a);
  phi_load = load.phi;
  annotation(experiment(StartTime = 0, StopTime = 50, Interval = 1e-2, Tolerance = 1e-6));
end EccentricLoadPlant;
