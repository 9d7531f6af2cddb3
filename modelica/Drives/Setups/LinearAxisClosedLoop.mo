within Drives.Setups;
model LinearAxisClosedLoop "Linear axis under its position controller"
  extends PartialLinearAxis;
  parameter Types.Rate kp = 160.18 "Gain of the position loop";
  parameter Real kv(unit = "V.s/m") = 243.45 "Gain of the speed loop";
  parameter Types.Time t_v(min = 1e-6) = 1e-3 "Lag of the controller's velocity: one sample, as the recorded control signal shows";
  parameter Types.Voltage vir_max(min = 0) = 10 "Largest control signal";
  input Types.Position qg "Reference position";
  input Types.Voltage pulses "Voltage added to the control signal";
  output Types.Voltage vir "Control signal";
  Signals.PositionController controller(kp = kp, kv = kv, t_v = t_v, u_max = vir_max,
    s_start = q_start - t_v*v_start) "Position controller";
equation
  controller.s_ref = qg;
  controller.s = mass.s;
  controller.u_add = pulses;
  connect(controller.u, motor.u);
  vir = controller.u;
  annotation(experiment(StartTime = 0, StopTime = 24.84, Interval = 1e-3, Tolerance = 1e-6));
end LinearAxisClosedLoop;
