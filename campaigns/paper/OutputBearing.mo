model OutputBearing "Free rotation with friction in the bearing of the output shaft"
  extends Drives.Setups.FreeShaft;
  parameter Drives.Types.Torque tau_out(min = 0) = 1 "Friction of the output bearing";
  Drives.Components.Friction bearing(tau_c = tau_out) "Output bearing";
  Drives.Components.Fixed ground "Frame";
equation
  connect(load.flange_b, bearing.flange_a);
  connect(bearing.flange_b, ground.flange);
  annotation(experiment(StartTime = 0, StopTime = 4, Interval = 2e-3, Tolerance = 1e-6));
end OutputBearing;
