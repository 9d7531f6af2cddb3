within Drives.Setups;
model FixedShaft "Output shaft locked, motor current given"
  extends PartialActuator(lossTable = [
    0, 1, 1, 0, 0;
    10, 1, 1, 0, 0;
    15, 1, 1, 0, 0;
    20, 1, 1, 0, 0;
    30, 1, 1, 0, 0;
    100, 1, 1, 0, 0;
    300, 1, 1, 0, 0]);
  input Types.Current i_cmd "Motor current";
  Components.Inertia load(J = J_L) "Load";
  Components.Fixed lock "Holds the output shaft";
equation
  motor.i = i_cmd;
  connect(flexspline.flange_b, load.flange_a);
  connect(load.flange_b, lock.flange);
  annotation(experiment(StartTime = 0, StopTime = 0.5, Interval = 1e-3, Tolerance = 1e-6), Documentation(info="<html>
<p>Without friction by default, as the paper's linear model: 0.5 A settle at 17.5 N.m (Fig. 6).</p>
</html>"));
end FixedShaft;
