within Pendulum.Friction;
model Quadratic "M6: M5, and at standstill a part that grows with the square of the torque that resists"
  import Drives.Types;
  extends PartialDirectional;
  parameter Real K_mq(unit = "1/(N.m)", min = 0) = 0 "At standstill, friction over the motor's torque squared while the load drives";
  parameter Real K_eq(unit = "1/(N.m)", min = 0) = 0 "At standstill, friction over the load's torque squared while the motor drives";
  Real driving(unit = "1") "1 while the motor's torque is the larger one, 0 while the load's is";
  Types.Torque opposed "The smaller of the two torques, 0 unless they point against each other";
  Types.Torque quadratic "Friction by the square of the opposed torque";
protected
  constant Types.Torque tau_b = 0.05 "Width over which driving changes";
equation
  driving = 0.5*(1 + tanh((noEvent(abs(tau_m)) - noEvent(abs(tau_e)))/tau_b));
  opposed = noEvent(if tau_m*tau_e < 0 then min(abs(tau_m), abs(tau_e)) else 0.0);
  quadratic = S*(driving*K_eq + (1 - driving)*K_mq)*opposed^2;
  budget = K_c + linear + quadratic;
  fluid = K_v*w;
end Quadratic;
