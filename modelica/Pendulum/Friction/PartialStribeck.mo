within Pendulum.Friction;
partial model PartialStribeck "Friction of which a part fades with speed"
  import Drives.Types;
  extends PartialFriction;
  parameter Types.Torque K_cs(min = 0) = 0 "Coulomb friction at standstill above that when turning";
  parameter Types.AngularVelocity w_s(min = 1e-3) = 0.2 "Speed at which the Stribeck part has fallen to 1/e";
  parameter Real alpha(unit = "1", min = 0.2) = 1.35 "Sharpness of its fall";
  Real S(unit = "1") "Stribeck's factor: 1 at standstill, 0 at speed";
equation
  S = exp(-((w/w_s)^2 + 1e-6)^(alpha/2));
end PartialStribeck;
