within Drives.Effects;
model AxisMotor "Drive with dead time, lag, saturation and force ripple"
  extends Translational.PartialForceMotor;
  parameter Types.Time delay(min = 0) = 0 "Dead time between control signal and force";
  parameter Types.Time lag(min = 0) = 0 "Time constant of the force";
  parameter Real saturation(unit = "1/V2", min = 0) = 0 "The force per signal falls with the root of 1 + saturation u^2";
  parameter Types.Force ripple_sin = 0 "Force ripple over the position, sine";
  parameter Types.Force ripple_cos = 0 "Force ripple over the position, cosine";
  parameter Types.Position pitch(min = 1e-6) = 0.02 "Period of the force ripple";
  Interfaces.RealInput f_port(unit = "N") "Added to the force";
  Delay dead(T = delay) "Dead time";
  Lag filter(T = lag) "Lag";
protected
  constant Real pi = 3.141592653589793 "Half the circumference of the unit circle";
  Types.Angle turn "Position in periods of the ripple";
equation
  dead.u = u;
  connect(dead.y, filter.u);
  turn = 2*pi*flange.s/pitch;
  f = gtau*filter.y/sqrt(1 + saturation*filter.y^2) + ripple_sin*sin(turn) + ripple_cos*cos(turn) + f_port;
end AxisMotor;
