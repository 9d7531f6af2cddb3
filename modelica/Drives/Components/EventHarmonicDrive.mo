within Drives.Components;
model EventHarmonicDrive "Harmonic Drive gear with a loss table that sticks and slides by events"
  extends PartialHarmonicDrive;
  Signals.StickSlip modes "Stuck, forward and backward";
equation
  modes.w = w;
  modes.forward = forward;
  modes.backward = backward;
  friction = modes.friction;
  lossPower = friction*w;
end EventHarmonicDrive;
