within Drives.Functions;
function slidingTorque "Loss torque of a gear sliding forward, explicit in the load torque (Table 1 of the paper)"
  input Types.Torque tau_load "Load torque referred to the driving side, T = -tau_F/n";
  input Real losses[4] "eta1, eta2, tau_bf1, tau_bf2 at the present speed";
  input Types.Torque tau_blend "Width of T over which the two branches blend";
  output Types.Torque dtau "Loss torque for positive speed; for negative speed it is -slidingTorque(-T, ...)";
protected
  Types.Torque driving "tau_W >= 0: (1 - eta1) tau_W + tau_bf1 with tau_W = T + dtau";
  Types.Torque braking "tau_W < 0: (1 - 1/eta2) tau_W + tau_bf2 with tau_W = T + dtau";
algorithm
  driving := (1/losses[1] - 1)*tau_load + losses[3]/losses[1];
  braking := (losses[2] - 1)*tau_load + losses[2]*losses[4];
  dtau := braking + max(0.0, min(1.0, 1 + (tau_load + losses[3])/tau_blend))*(driving - braking);
  annotation(Documentation(info="<html>
<p>The driving branch holds where T &gt;= -tau_bf1. Table 1 jumps there if tau_bf1 and tau_bf2 differ; the jump is
spread over tau_blend below that point, so that the law is continuous.</p>
</html>"));
end slidingTorque;
