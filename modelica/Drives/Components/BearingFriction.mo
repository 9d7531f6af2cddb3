within Drives.Components;
model BearingFriction "Friction between two flanges that sticks and slides by events"
  extends Interfaces.PartialCompliant;
  parameter Types.Torque tau_c(min = 0, start = 0.1) "Coulomb friction";
  parameter Types.RotationalDampingConstant b = 0 "Viscous friction";
  parameter Real peak(unit = "1", min = 1) = 1 "Break-away torque over Coulomb friction";
  Signals.StickSlip modes(peak = peak) "Stuck, forward and backward";
  Types.Power lossPower "Power turned into heat";
equation
  modes.w = w_rel;
  modes.forward = tau_c + b*w_rel;
  modes.backward = -tau_c + b*w_rel;
  tau = modes.friction;
  lossPower = tau*w_rel;
end BearingFriction;
