within Drives.Components;
model LossyGear "Gear with mesh and bearing friction that sticks and slides by events"
  extends Interfaces.PartialTwoFlanges;
  parameter Real ratio(unit = "1", start = 1) "Ratio, flange_a.phi/flange_b.phi";
  parameter Real lossTable[:, 5] = [0, 1, 1, 0, 0] "Rows of |w_a| (strictly increasing), eta1, eta2, tau_bf1, tau_bf2";
  parameter Types.Torque tau_blend(min = 0) = 1e-3 "Width over which the branches of Table 1 blend if tau_bf1 <> tau_bf2";
  Types.AngularVelocity w_a "Speed of flange_a";
  Types.Torque tau_load "Load torque referred to flange_a";
  Types.Torque tau_loss "Torque on flange_a that the lossless gear lacks";
  Types.Power lossPower "Power turned into heat";
  Signals.StickSlip modes "Stuck, forward and backward";
protected
  Real losses[4] "Interpolated loss table: eta1, eta2, tau_bf1, tau_bf2";
equation
  flange_a.phi = ratio*flange_b.phi;
  flange_b.tau = -ratio*(flange_a.tau - tau_loss);
  tau_load = -flange_b.tau/ratio;
  w_a = der(flange_a.phi);
  losses = noEvent(Functions.interpolateLosses(abs(w_a), lossTable));
  modes.w = w_a;
  modes.forward = noEvent(Functions.slidingTorque(tau_load, losses, tau_blend));
  modes.backward = -noEvent(Functions.slidingTorque(-tau_load, losses, tau_blend));
  tau_loss = modes.friction;
  lossPower = tau_loss*w_a;
end LossyGear;
