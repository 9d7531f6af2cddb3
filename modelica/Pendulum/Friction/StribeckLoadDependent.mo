within Pendulum.Friction;
model StribeckLoadDependent "M4: M3, and more at standstill, also under load"
  extends PartialStribeck;
  parameter Real K_l(unit = "1", min = 0) = 0 "Friction over the torque that the gear transmits";
  parameter Real K_ls(unit = "1", min = 0) = 0 "At standstill, friction over the torque that the gear transmits";
equation
  budget = K_c + S*K_cs + (K_l + S*K_ls)*noEvent(abs(tau_m - tau_e));
  fluid = K_v*w;
end StribeckLoadDependent;
