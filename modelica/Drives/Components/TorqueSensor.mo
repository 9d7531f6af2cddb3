within Drives.Components;
model TorqueSensor "Compliant torque sensor: its reading is the torque of a spring and damper"
  extends SpringDamper;
  Interfaces.RealOutput tau_sensor(unit = "N.m") "Measured torque, on flange_a";
equation
  tau_sensor = tau;
end TorqueSensor;
