within Pendulum.Components;
block Controller "Torque by position error and speed"
  extends PartialController;
equation
  tau = enable*(kp*(q_ref - q) - kd*w)/n;
end Controller;
