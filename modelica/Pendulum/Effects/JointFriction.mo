within Pendulum.Effects;
model JointFriction "Friction with every law's part, each off at zero, and more"
  extends Friction.PartialQuadratic;
  import Drives.Types;
  parameter Real K_l(unit = "1", min = 0) = 0 "Friction over the torque that the gear transmits";
  parameter Real K_ls(unit = "1", min = 0) = 0 "At standstill, friction over the torque that the gear transmits";
  parameter Types.Torque coulomb_asymmetry = 0 "Coulomb friction more when turning forward, and less when backward";
  parameter Types.RotationalDampingConstant viscous_asymmetry = 0 "Viscous friction more when turning forward, and less when backward";
  parameter Real drag(unit = "N.m.s2/rad2") = 0 "Friction over speed squared";
  parameter Types.RotationalDampingConstant brake(min = 0) = 0 "Viscous friction more while the torque is off";
  parameter Types.Torque wave_sin = 0 "Dry friction over the joint's angle, sine";
  parameter Types.Torque wave_cos = 0 "Dry friction over the joint's angle, cosine";
  parameter Real wave_order(unit = "1", min = 0.1) = 1 "Periods of that a turn of the joint";
  Drives.Interfaces.RealInput off(unit = "1") "1 while the torque is off";
  Drives.Interfaces.RealInput tau_port(unit = "N.m") "Added to the friction";
protected
  Types.Torque dry "Dry friction that no direction of turning counts in";
  Types.Angle turn "Angle in periods of the wave";
equation
  turn = wave_order*flange.phi;
  dry = K_c + linear + quadratic + (K_l + S*K_ls)*noEvent(abs(tau_m - tau_e)) + wave_sin*sin(turn) + wave_cos*cos(turn);
  budget = noEvent(max(0.0, dry + (if bristle.share > 0 then coulomb_asymmetry else -coulomb_asymmetry)));
  fluid = (K_v + brake*off)*w + noEvent((viscous_asymmetry + drag*w)*abs(w)) + tau_port;
end JointFriction;
