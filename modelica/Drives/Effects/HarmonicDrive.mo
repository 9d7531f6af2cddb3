within Drives.Effects;
model HarmonicDrive "Harmonic Drive gear with friction beyond a constant, torque ripple and transmission error"
  extends Components.PartialHarmonicDrive;
  parameter Types.RotationalDampingConstant viscous(min = 0) = 0 "Bearing friction over speed";
  parameter Types.Torque stribeck = 0 "Bearing friction at standstill above that when sliding";
  parameter Types.AngularVelocity stribeck_speed(min = 0) = 10 "Speed at which the Stribeck part has fallen to 1/e";
  parameter Real stribeck_exponent(unit = "1", min = 0.2) = 2 "The Stribeck part is exp(-|w/stribeck_speed|^stribeck_exponent)";
  parameter Types.Torque asymmetry = 0 "Bearing friction more when sliding forward, and less when backward";
  parameter Real mesh_eta1(unit = "1", min = 0, max = 1) = 1 "Mesh efficiency when driving, beside that of the loss table";
  parameter Real mesh_eta2(unit = "1", min = 0, max = 1) = 1 "Mesh efficiency when driven, beside that of the loss table";
  parameter Types.Torque ripple_sin = 0 "Torque ripple at two periods a turn of the Wave Generator, sine";
  parameter Types.Torque ripple_cos = 0 "Torque ripple at two periods a turn of the Wave Generator, cosine";
  parameter Types.Angle error_sin = 0 "Transmission error at two periods a turn of the Wave Generator, sine";
  parameter Types.Angle error_cos = 0 "Transmission error at two periods a turn of the Wave Generator, cosine";
  parameter Real thermal(unit = "1/W") = 0 "Bearing friction falls with exp(-thermal times the warmth)";
  parameter Types.Time thermal_time(min = 0) = 20 "Time constant of warming up";
  Interfaces.RealInput tau_port(unit = "N.m") "Added to the loss torque";
  Types.Power warmth(start = 0, fixed = true) "Lost power behind the time constant of warming up";
protected
  Types.Torque extra "Bearing friction over speed, both directions";
  Real error_slope(unit = "1") "Transmission error over the angle of the Wave Generator";
  Real cold(unit = "1") "Share of the bearing friction left by warming up";
equation
  der(warmth) = noEvent(if abs(thermal) > 0 then (lossPower - warmth)/thermal_time else 0.0);
  cold = exp(-thermal*warmth);
  extra = viscous*noEvent(abs(w)) + stribeck*exp(-((w/stribeck_speed)^2 + 1e-6)^(stribeck_exponent/2));
  losses_forward[1] = losses[1]*mesh_eta1;
  losses_forward[2] = losses[2]*mesh_eta2;
  losses_forward[3] = cold*noEvent(max(0.0, losses[3] + extra + asymmetry));
  losses_forward[4] = cold*noEvent(max(0.0, losses[4] + extra + asymmetry));
  losses_backward[1] = losses[1]*mesh_eta1;
  losses_backward[2] = losses[2]*mesh_eta2;
  losses_backward[3] = cold*noEvent(max(0.0, losses[3] + extra - asymmetry));
  losses_backward[4] = cold*noEvent(max(0.0, losses[4] + extra - asymmetry));
  phi_error = error_sin*sin(2*phi_rel) + error_cos*(cos(2*phi_rel) - 1);
  error_slope = 2*(error_sin*cos(2*phi_rel) - error_cos*sin(2*phi_rel));
  dtau = friction + n*tau_load*error_slope + ripple_sin*sin(2*phi_rel) + ripple_cos*cos(2*phi_rel) + tau_port;
end HarmonicDrive;
