within Drives.Components;
partial model PartialHarmonicDrive "Harmonic Drive gear with a loss table; what holds it at rest is left open"
  parameter Real n(unit = "1", start = 50) "Gear ratio";
  parameter Real lossTable[:, 5] = [0, 1, 1, 0, 0] "Rows of |w| (strictly increasing), eta1, eta2, tau_bf1, tau_bf2";
  parameter Types.Angle phi_s(min = 0) = 2e-5 "Presliding deflection of the stuck gear, Wave Generator side";
  parameter Types.Time t_s(min = 0) = 1e-3 "Damping time of the stuck gear's deflection";
  parameter Real z_e(unit = "1", min = 0, max = 0.999) = 0.9 "Purely elastic share of the presliding deflection";
  parameter Types.Torque tau_blend(min = 0) = 1e-3 "Width over which the branches of Table 1 blend if tau_bf1 <> tau_bf2";
  Interfaces.Flange_a W "Wave Generator";
  Interfaces.Flange_a C "Circular Spline";
  Interfaces.Flange_b F "Flexspline";
  Types.Angle phi_rel "Angle of the Wave Generator relative to the Circular Spline";
  Types.AngularVelocity w "Speed of the Wave Generator relative to the Circular Spline";
  Types.Torque tau_load "Load torque referred to the Wave Generator, T";
  Types.Torque dtau "Torque between Wave Generator and Circular Spline that the lossless gear lacks";
  Types.Torque friction "Loss torque";
  Types.Power lossPower "Power turned into heat";
protected
  Real losses[4] "Interpolated loss table: eta1, eta2, tau_bf1, tau_bf2";
  Types.Torque forward "Loss torque if it slides forward";
  Types.Torque backward "Loss torque if it slides backward";
equation
  phi_rel = W.phi - C.phi;
  w = der(phi_rel);
  W.phi = (1 - n)*C.phi + n*F.phi;
  F.tau = -n*(W.tau - dtau);
  C.tau = (n - 1)*W.tau - n*dtau;
  dtau = friction;
  tau_load = -F.tau/n;
  losses = noEvent(Functions.interpolateLosses(abs(w), lossTable));
  forward = noEvent(Functions.slidingTorque(tau_load, losses, tau_blend));
  backward = -noEvent(Functions.slidingTorque(-tau_load, losses, tau_blend));
  annotation(Documentation(info="<html>
<p>Eqs. (1) and (2) of the paper; dtau acts on the speed of the Wave Generator relative to the Circular Spline. With the
load torque T known from the Flexspline, Table 1 is explicit (Functions.slidingTorque): no algebraic loop. Between the
two sliding values the gear is stuck. HarmonicDrive gets from one to the other by a bristle,
EventHarmonicDrive by events; a gear that needs no presliding deflection leaves phi_s, t_s and z_e unused.</p>
</html>"));
end PartialHarmonicDrive;
