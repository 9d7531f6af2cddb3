within Drives.Components;
model TorqueSensor "Compliant torque sensor: its reading is the torque of a spring and damper"
  extends PartialTorqueSensor;
equation
  tau_sensor = tau;
end TorqueSensor;
