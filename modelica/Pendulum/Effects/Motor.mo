within Pendulum.Effects;
model Motor "Motor with dead time, lag, saturation, a limit that falls with speed, and torque ripple"
  extends Components.PartialMotor;
  import Drives.Types;
  parameter Types.Time delay(min = 0) = 0 "Dead time between demanded torque and torque";
  parameter Types.Time lag(min = 0) = 0 "Time constant of the torque";
  parameter Real saturation(unit = "1/(N2.m2)", min = 0) = 0 "The torque falls with the root of 1 + saturation u^2";
  parameter Types.RotationalDampingConstant back_emf(min = 0) = 0 "Fall of the largest torque over the speed at which it drives";
  parameter Types.Torque ripple_sin = 0 "Torque ripple over the rotor's angle, sine";
  parameter Types.Torque ripple_cos = 0 "Torque ripple over the rotor's angle, cosine";
  parameter Real order(unit = "1", min = 0.1) = 1 "Periods of the ripple a turn of the rotor";
  Drives.Effects.Delay dead(T = delay) "Dead time";
  Drives.Effects.Lag filter(T = lag) "Lag";
  Types.AngularVelocity w(nominal = 1) "Speed of the rotor";
protected
  Types.Torque limit "Largest torque at this speed, in the direction of the demanded one";
  Types.Torque saturated "Torque before the limit";
  Types.Angle turn "Angle in periods of the ripple";
equation
  w = der(flange.phi);
  dead.u = u;
  connect(dead.y, filter.u);
  saturated = filter.y/sqrt(1 + saturation*filter.y^2);
  limit = noEvent(max(0.0, tau_max - back_emf*max(0.0, if filter.y > 0 then w else -w)));
  turn = order*flange.phi;
  tau = gain*noEvent(max(-limit, min(limit, saturated))) + ripple_sin*sin(turn) + ripple_cos*cos(turn);
end Motor;
