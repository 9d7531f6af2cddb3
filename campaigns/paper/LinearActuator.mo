model LinearActuator "Fig. 5 of the paper: the actuator with its shaft held, without losses"
  parameter Real n(unit = "1") = 50 "Gear ratio";
  parameter Real K_m(unit = "N.m/A") = 0.7 "Torque constant of the motor";
  parameter Real J_R(unit = "kg.m2") = 2e-4 "Rotor with Wave Generator";
  parameter Real J_S(unit = "kg.m2") = 0.003 "Housing with stator and Circular Spline";
  parameter Real c_S(unit = "N.m/rad") = 130000 "Stiffness of the torque sensor";
  parameter Real d_S(unit = "N.m.s/rad") = 0.6 "Damping of the torque sensor";
  parameter Real c_G(unit = "N.m/rad") = 25500 "Stiffness of the Flexspline";
  parameter Real d_G(unit = "N.m.s/rad") = 50 "Damping of the Flexspline";
  input Real i_cmd(unit = "A") "Current of the motor";
  output Real tau_sensor(unit = "N.m") "Torque between housing and console";
  output Real phi_rel(unit = "rad") "Rotor against housing, as the encoder reads it";
  Real phi_C(unit = "rad", start = 0, fixed = true, nominal = 1e-4) "Housing";
  Real w_C(unit = "rad/s", start = 0, fixed = true);
  Real phi_W(unit = "rad", start = 0, fixed = true) "Rotor";
  Real w_W(unit = "rad/s", start = 0, fixed = true);
  Real phi_F(unit = "rad") "Flexspline";
  Real tau_W(unit = "N.m") "Torque of the rotor on the gear";
equation
  der(phi_C) = w_C;
  der(phi_W) = w_W;
  // Eq. (1): the gear, and its torques
  phi_W = (1 - n)*phi_C + n*phi_F;
  n*tau_W = c_G*phi_F + d_G*der(phi_F);
  J_R*der(w_W) = K_m*i_cmd - tau_W;
  J_S*der(w_C) = tau_sensor - K_m*i_cmd - (n - 1)*tau_W;
  tau_sensor = -c_S*phi_C - d_S*w_C;
  phi_rel = phi_W - phi_C;
end LinearActuator;
