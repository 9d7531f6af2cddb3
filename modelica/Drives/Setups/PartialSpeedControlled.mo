within Drives.Setups;
partial model PartialSpeedControlled "Actuator under the rig's speed controller"
  extends PartialActuator(rotor(phi(start = n*phi_load_start, fixed = true), w(start = w_motor_start, fixed = true)));
  parameter Real kp(unit = "A.s/rad") = 0.02 "Proportional gain of the speed controller";
  parameter Real ki(unit = "A/rad") = 0.4 "Integral gain of the speed controller";
  parameter Types.Current i_max(min = 0) = 6 "Largest current of the speed controller";
  parameter Types.Angle phi_load_start = 0 "Start angle of the load; the Flexspline starts relaxed";
  parameter Types.AngularVelocity w_motor_start = 0 "Start speed of the rotor; the load starts at 1/n of it";
  parameter Types.Current i_start = 0 "Start value of the controller's integral part";
  input Types.AngularVelocity w_ref "Reference speed of the rotor relative to the housing";
  output Types.Current i_motor "Current of the motor";
  Signals.SpeedController controller(kp = kp, ki = ki, i_max = i_max, integral_start = i_start) "Speed controller of the rig";
equation
  controller.w_ref = w_ref;
  connect(encoder.w_rel, controller.w);
  connect(controller.i, motor.i);
  i_motor = controller.i;
end PartialSpeedControlled;
