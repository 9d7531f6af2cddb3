within Pendulum.Components;
model Gear "Ideal reduction gear: its losses are those of the joint's friction"
  extends Drives.Interfaces.PartialTwoFlanges;
  parameter Real n(unit = "1") = 1 "Ratio, angle of flange_a over that of flange_b";
equation
  flange_a.phi = n*flange_b.phi;
  flange_b.tau = -n*flange_a.tau;
end Gear;
