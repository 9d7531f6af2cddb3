within Drives.Components;
partial model PartialTorqueSensor "Compliant torque sensor; how its reading follows from its torque is left open"
  extends SpringDamper;
  Interfaces.RealOutput tau_sensor(unit = "N.m") "Measured torque, on flange_a";
end PartialTorqueSensor;
