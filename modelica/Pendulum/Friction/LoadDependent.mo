within Pendulum.Friction;
model LoadDependent "M3: M1, and more under load"
  extends PartialFriction;
  parameter Real K_l(unit = "1", min = 0) = 0 "Friction over the torque that the gear transmits";
equation
  budget = K_c + K_l*noEvent(abs(tau_m - tau_e));
  fluid = K_v*w;
end LoadDependent;
