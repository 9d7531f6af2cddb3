within Pendulum.Effects;
model Encoder "Encoder on the rotor, from which the load bends the gear and takes up its play"
  extends Components.PartialEncoder;
  import Drives.Types;
  parameter Real compliance(unit = "rad/(N.m)", min = 0) = 0 "Deflection of the gear over the load";
  parameter Types.Angle backlash(min = 0) = 0 "Play, taken up by the weight of the load";
protected
  constant Types.Torque tau_b = 0.05 "Load that takes up three quarters of the play";
equation
  q = phi + offset - compliance*tau - backlash/2*tanh(tau/tau_b);
end Encoder;
