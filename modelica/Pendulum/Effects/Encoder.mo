within Pendulum.Effects;
model Encoder "Encoder on the rotor, before a gear whose play the load takes up"
  extends Components.PartialEncoder;
  import Drives.Types;
  parameter Types.Angle backlash(min = 0) = 0 "Play, taken up by the weight of the load";
protected
  constant Types.Torque tau_b = 0.05 "Load that takes up three quarters of the play";
equation
  q = phi + offset - backlash/2*tanh(tau/tau_b);
end Encoder;
