within Pendulum.Effects;
block Controller "Position controller that gets its reference late and counts the speed wrongly"
  extends Components.PartialController;
  import Drives.Types;
  parameter Types.Time delay(min = 0) = 0 "Dead time of the reference";
  parameter Types.Time lag(min = 0) = 0 "Time constant of the reference";
  parameter Real speed_gain(unit = "1") = 1 "Gain of the speed over the nominal one";
  Drives.Interfaces.RealInput q_port(unit = "rad") "Added to the reference";
  Drives.Effects.Delay dead(T = delay) "Dead time of the reference";
  Drives.Effects.Lag filter(T = lag) "Lag of the reference";
equation
  dead.u = q_ref + q_port;
  connect(dead.y, filter.u);
  tau = enable*(kp*(filter.y - q) - speed_gain*kd*w)/n;
end Controller;
