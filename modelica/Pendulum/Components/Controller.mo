within Pendulum.Components;
block Controller "Torque by position error and speed"
  import Drives.Types;
  parameter Types.RotationalSpringConstant kp = 10 "Gain of the position error, at the joint";
  parameter Types.RotationalDampingConstant kd = 0.3 "Gain of the speed, at the joint";
  parameter Real n(unit = "1") = 1 "Gear ratio";
  Drives.Interfaces.RealInput q_ref(unit = "rad") "Reference angle of the joint";
  Drives.Interfaces.RealInput q(unit = "rad") "Measured angle of the joint";
  Drives.Interfaces.RealInput w(unit = "rad/s") "Measured speed of the joint";
  Drives.Interfaces.RealInput enable(unit = "1") "1: torque on, 0: torque off";
  Drives.Interfaces.RealOutput tau(unit = "N.m") "Demanded torque, motor side";
equation
  tau = enable*(kp*(q_ref - q) - kd*w)/n;
end Controller;
