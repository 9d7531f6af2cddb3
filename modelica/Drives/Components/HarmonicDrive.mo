within Drives.Components;
model HarmonicDrive "Harmonic Drive gear with a loss table that a bristle holds at rest, without events"
  extends PartialHarmonicDrive;
  Signals.Bristle bristle(t_s = t_s, z_e = z_e) "Share of the sliding torque that acts";
equation
  bristle.v = w/phi_s;
  friction = forward*noEvent(max(0.0, bristle.share)) + backward*noEvent(max(0.0, -bristle.share));
  lossPower = friction*w - phi_s*der(bristle.z)*(forward*noEvent(max(0.0, bristle.z)) + backward*noEvent(max(0.0, -bristle.z)));
end HarmonicDrive;
