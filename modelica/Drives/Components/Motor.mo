within Drives.Components;
model Motor "Torque proportional to current between stator and rotor"
  extends PartialMotor;
equation
  tau = K_m*i;
end Motor;
