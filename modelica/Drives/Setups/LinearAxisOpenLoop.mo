within Drives.Setups;
model LinearAxisOpenLoop "Linear axis driven by a given control signal"
  extends PartialLinearAxis;
  input Types.Voltage vir "Control signal";
equation
  motor.u = vir;
  annotation(experiment(StartTime = 0, StopTime = 24.84, Interval = 1e-3, Tolerance = 1e-6));
end LinearAxisOpenLoop;
