within Drives.Components;
model RelativeSpeedSensor "Measures the angular velocity of flange_b relative to flange_a"
  extends Interfaces.PartialTwoFlanges;
  Types.Angle phi_rel "Relative angle, flange_b.phi - flange_a.phi";
  Interfaces.RealOutput w_rel(unit = "rad/s") "Relative angular velocity";
equation
  phi_rel = flange_b.phi - flange_a.phi;
  w_rel = der(phi_rel);
  flange_a.tau = 0;
  flange_b.tau = 0;
end RelativeSpeedSensor;
