within Pendulum.Setups;
model TorqueDriven "Servo pendulum under a given torque"
  import Drives.Types;
  extends PartialServo;
  input Types.Torque tau_ref "Demanded torque, motor side";
equation
  motor.u = tau_ref;
  annotation(experiment(StartTime = 0, StopTime = 6, Interval = 0.016, Tolerance = 1e-6));
end TorqueDriven;
