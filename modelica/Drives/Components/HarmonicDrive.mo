within Drives.Components;
model HarmonicDrive "Harmonic Drive gear with a loss table for mesh and bearing friction"
  extends PartialHarmonicDrive;
equation
  losses_forward = losses;
  losses_backward = losses;
  dtau = friction;
end HarmonicDrive;
