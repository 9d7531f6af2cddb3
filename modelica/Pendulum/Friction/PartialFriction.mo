within Pendulum.Friction;
partial model PartialFriction "Friction of a joint against the ground; how much dry friction there is, is left open"
  import Drives.Types;
  parameter Types.RotationalDampingConstant K_v = 0.1 "Viscous friction";
  parameter Types.Torque K_c(min = 0) = 0.2 "Coulomb friction";
  parameter Types.Angle phi_s(min = 0) = 2e-5 "Presliding deflection: the stuck friction deflects by this at break-away";
  Drives.Interfaces.Flange_a flange "Joint";
  Drives.Interfaces.RealInput tau_m(unit = "N.m") "Torque of the motor at the joint";
  Drives.Interfaces.RealInput tau_e(unit = "N.m") "Torque of the load at the joint";
  Types.AngularVelocity w(nominal = 1) "Speed of the joint";
  Types.Torque budget "What dry friction takes while the joint turns, and can hold while it rests";
  Types.Torque fluid "Friction that vanishes at standstill";
  Types.Torque tau "Friction torque";
  Drives.Signals.Bristle bristle "Share of the dry friction that acts";
equation
  w = der(flange.phi);
  bristle.v = w/phi_s;
  tau = fluid + budget*bristle.share;
  flange.tau = tau;
end PartialFriction;
