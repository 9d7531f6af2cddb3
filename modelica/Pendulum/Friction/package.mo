within Pendulum;
package Friction "Friction laws of a geared joint, each beside the one that it extends"
  annotation(Documentation(info="<html>
<p>A law says how much torque dry friction can hold or take; what acts is the share of it that stops the joint
(Drives.Signals.Bristle), so that a joint at rest stays where it is. With S = exp(-(|w|/w_s)^alpha):</p>
<pre>
M1 CoulombViscous         K_v|w| + K_c
M2 Stribeck               M1 + S K_cs
M3 LoadDependent          M1 + K_l|tau_m - tau_e|
M4 StribeckLoadDependent  M3 + S (K_cs + K_ls|tau_m - tau_e|)
M5 Directional            M1 + |K_m tau_m - K_e tau_e| + S (K_cs + |K_ms tau_m - K_es tau_e|)
M6 Quadratic              M5 + S (K_mq tau_m^2 where driven by the load, K_eq tau_e^2 where driving it)
</pre>
<p>tau_m is the motor's torque at the joint, tau_e that of the load. They point against each other while the motor holds
or moves the load, so that their difference is then about twice the load. Without Stribeck parts and with
K_m = K_e = K_l, M6 is M3; each law is in M6.</p>
</html>"));
end Friction;
