within Pendulum.Friction;
partial model PartialDirectional "Stribeck friction with shares of the motor's and of the load's torque"
  import Drives.Types;
  extends PartialStribeck;
  parameter Real K_m(unit = "1", min = 0) = 0 "Friction over the motor's torque";
  parameter Real K_e(unit = "1", min = 0) = 0 "Friction over the load's torque";
  parameter Real K_ms(unit = "1", min = 0) = 0 "At standstill, friction over the motor's torque";
  parameter Real K_es(unit = "1", min = 0) = 0 "At standstill, friction over the load's torque";
  Types.Torque linear "Friction by the torques through the gear";
equation
  linear = noEvent(abs(K_m*tau_m - K_e*tau_e)) + S*(K_cs + noEvent(abs(K_ms*tau_m - K_es*tau_e)));
end PartialDirectional;
