within Drives.Setups;
model LinearAxisClosedLoop "Linear axis under its position controller"
  extends PartialLinearAxis;
  parameter Types.Rate kp = 160.18 "Gain of the position loop";
  parameter Real kv(unit = "V.s/m") = 243.45 "Gain of the speed loop";
  parameter Types.Voltage vir_max(min = 0) = 10 "Largest control signal";
  input Types.Position qg "Reference position";
  input Types.Voltage pulses "Voltage added to the control signal";
  output Types.Voltage vir "Control signal";
  Signals.PositionController controller(kp = kp, kv = kv, u_max = vir_max) "Position controller";
equation
  controller.s_ref = qg;
  controller.s = mass.s;
  controller.u_add = pulses;
  connect(controller.u, motor.u);
  vir = controller.u;
  annotation(experiment(StartTime = 0, StopTime = 24.84, Interval = 1e-3, Tolerance = 1e-6));
end LinearAxisClosedLoop;
