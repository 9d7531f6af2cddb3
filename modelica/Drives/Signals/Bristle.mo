within Drives.Signals;
block Bristle "Friction as a share of break-away, event-free, with a true stuck mode"
  parameter Types.Time t_s(min = 0) = 1e-3 "Damping time of the bristle";
  parameter Real z_e(unit = "1", min = 0, max = 0.999) = 0.9 "Purely elastic up to this share of the deflection";
  Interfaces.RealInput v(unit = "1/s") "Sliding speed over presliding deflection";
  Interfaces.RealOutput share(unit = "1") "Friction over break-away friction, in [-1, 1]";
  Real z(start = 0, fixed = true, nominal = 1, unit = "1") "Deflection over presliding deflection, in [-1, 1]";
equation
  der(z) = noEvent(Functions.bristleRate(v, z, z_e));
  share = noEvent(max(-1.0, min(1.0, z + t_s*der(z))));
  annotation(Documentation(info="<html>
<p>Elasto-plastic bristle (Dupont and others, 2002) with a bounded damping torque:
der(z) = v (1 - beta(|z|)) while it is wound up further, else v; beta = ((|z| - z_e)/(1 - z_e))^2 above z_e, else 0;
share = z + t_s der(z), limited to +-1. It follows that</p>
<ul>
<li>in steady sliding |share| is exactly 1: the sliding law is untouched;</li>
<li>a constant load below break-away deflects the bristle and holds: der(z) vanishes only with v, and below z_e
nothing slides even under vibration;</li>
<li>share - z has the sign of v: what is not stored in the bristle is lost, never gained;</li>
<li>within v = +-1/t_s the law is a viscous damper, so a body on the bristle does not ring: with
inertia J, friction tau_c and presliding deflection phi_s it is critically damped at t_s = 2 sqrt(J phi_s/tau_c).</li>
</ul>
</html>"));
end Bristle;
