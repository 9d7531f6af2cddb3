within Drives.Components;
model HarmonicDrive "Harmonic Drive gear with a loss table for mesh and bearing friction"
  extends PartialEventFreeHarmonicDrive;
equation
  losses_forward = losses;
  losses_backward = losses;
  phi_error = 0;
  dtau = friction;
end HarmonicDrive;
