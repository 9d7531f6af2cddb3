within Drives.Components;
partial model PartialHarmonicDrive "Harmonic Drive gear; what is lost at a speed is left open"
  parameter Real n(unit = "1", start = 50) "Gear ratio";
  parameter Real lossTable[:, 5] = [0, 1, 1, 0, 0] "Rows of |w| (strictly increasing), eta1, eta2, tau_bf1, tau_bf2";
  parameter Types.Angle phi_s(min = 0) = 2e-5 "Presliding deflection of the stuck gear, Wave Generator side";
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
  Signals.Bristle bristle "Share of the sliding torque that acts";
protected
  Types.Angle phi_error "Transmission error: the Flexspline is ahead of the ideal gear by this";
  Real losses[4] "Interpolated loss table: eta1, eta2, tau_bf1, tau_bf2";
  Real losses_forward[4] "eta1, eta2, tau_bf1, tau_bf2 for sliding forward";
  Real losses_backward[4] "eta1, eta2, tau_bf1, tau_bf2 for sliding backward";
  Types.Torque forward "Loss torque if it slides forward";
  Types.Torque backward "Loss torque if it slides backward";
equation
  phi_rel = W.phi - C.phi;
  w = der(phi_rel);
  W.phi = (1 - n)*C.phi + n*(F.phi - phi_error);
  F.tau = -n*(W.tau - dtau);
  C.tau = (n - 1)*W.tau - n*dtau;
  tau_load = -F.tau/n;
  losses = noEvent(Functions.interpolateLosses(abs(w), lossTable));
  forward = noEvent(Functions.slidingTorque(tau_load, losses_forward, tau_blend));
  backward = -noEvent(Functions.slidingTorque(-tau_load, losses_backward, tau_blend));
  bristle.v = w/phi_s;
  friction = forward*noEvent(max(0.0, bristle.share)) + backward*noEvent(max(0.0, -bristle.share));
  lossPower = friction*w - phi_s*der(bristle.z)*(forward*noEvent(max(0.0, bristle.z)) + backward*noEvent(max(0.0, -bristle.z)));
  annotation(Documentation(info="<html>
<p>Eqs. (1) and (2) of the paper; dtau acts on the speed of the Wave Generator relative to the Circular Spline. With the
load torque T known from the Flexspline, Table 1 is explicit (Functions.slidingTorque): no algebraic loop. Between the
two sliding values the gear is stuck; how it gets from one to the other is Signals.Bristle.</p>
</html>"));
end PartialHarmonicDrive;
