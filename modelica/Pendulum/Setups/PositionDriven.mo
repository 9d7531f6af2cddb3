within Pendulum.Setups;
model PositionDriven "Servo pendulum under its position controller"
  import Drives.Types;
  extends PartialServo;
  parameter Types.RotationalSpringConstant kp = 10 "Gain of the position error, at the joint";
  parameter Types.RotationalDampingConstant kd = 0.3 "Gain of the speed, at the joint";
  input Types.Angle q_ref "Reference angle of the joint";
  input Real enable(unit = "1", start = 1) "1: torque on, 0: torque off";
  Components.Controller controller(kp = kp, kd = kd, n = n) "Position controller";
equation
  controller.q_ref = q_ref;
  controller.q = q;
  controller.w = w;
  controller.enable = enable;
  motor.u = controller.tau;
  annotation(experiment(StartTime = 0, StopTime = 6, Interval = 0.016, Tolerance = 1e-6));
end PositionDriven;
