within Drives.Components;
model Friction "Bearing friction between two flanges: a torque over speed that opposes the relative motion"
  extends Interfaces.PartialCompliant;
  parameter Types.Torque tau_c(min = 0, start = 0.1) "Coulomb friction, also the break-away torque";
  parameter Types.RotationalDampingConstant b = 0 "Viscous friction";
  parameter Types.Angle phi_s(min = 0) = 2e-5 "Presliding deflection: the stuck friction deflects by this at break-away";
  Signals.Bristle bristle "Share of the Coulomb friction that acts";
  Types.Power lossPower "Power turned into heat";
equation
  bristle.v = w_rel/phi_s;
  tau = tau_c*bristle.share + b*w_rel;
  lossPower = tau*w_rel - tau_c*bristle.z*phi_s*der(bristle.z);
end Friction;
