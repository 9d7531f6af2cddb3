within Drives.Effects;
model OutputTorque "Torque on the output shaft: an unknown eccentric mass, and a port"
  parameter Types.Torque imbalance_sin = 0 "Torque -imbalance_sin sin(phi)";
  parameter Types.Torque imbalance_cos = 0 "Torque -imbalance_cos cos(phi)";
  Interfaces.RealInput tau_port(unit = "N.m") "Torque added on the shaft";
  Interfaces.Flange_a flange "Output shaft";
equation
  flange.tau = imbalance_sin*sin(flange.phi) + imbalance_cos*cos(flange.phi) - tau_port;
end OutputTorque;
