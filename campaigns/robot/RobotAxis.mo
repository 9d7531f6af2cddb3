model RobotAxis "One axis of a robot, its motor moved as it was measured: what torque that takes, where its link then is"
  connector Flange "An angle on the link's side of the gear, and a torque"
    Real phi(unit = "rad");
    flow Real tau(unit = "N.m");
  end Flange;

  model Motor "Moves as it is told; rotor and friction take their share of the torque"
    Flange flange;
    input Real q(unit = "rad") "Angle, over the gear ratio";
    input Real w(unit = "rad/s") "Speed, over the gear ratio";
    input Real a(unit = "rad/s2") "Acceleration, over the gear ratio";
    output Real tau(unit = "N.m") "Torque of the motor";
    parameter Real ratio(unit = "1") = 256.857 "Of the gear";
    parameter Real J(unit = "kg.m2", min = 0) = 0.00923 "Inertia of the rotor";
    parameter Real f_vis(unit = "N.m.s/rad", min = 0) = 2000 "Viscous friction";
    parameter Real f_coul(unit = "N.m", min = 0) = 300 "Coulomb friction";
    parameter Real f_asym(unit = "N.m") = 0 "Friction forward above that backward, half of it; or an offset of the torque";
    parameter Real w_f(unit = "rad/s") = 0.01 "Speed where Coulomb friction has 0.76 of its size";
  equation
    flange.phi = q;
    ratio*tau = ratio^2*J*a + f_vis*w + f_coul*tanh(w/w_f) + f_asym - flange.tau;
  end Motor;

  model Gear "Elastic and damped"
    Flange motor;
    Flange link;
    parameter Real c(unit = "N.m/rad", min = 0) = 4e6 "Stiffness";
    parameter Real d(unit = "N.m.s/rad", min = 0) = 4e3 "Damping";
    input Real w(unit = "rad/s") "Speed of the motor, over the gear ratio";
    Real twist(unit = "rad") "Motor ahead of link";
  equation
    twist = motor.phi - link.phi;
    motor.tau = c*twist + d*(w - der(link.phi));
    motor.tau + link.tau = 0;
  end Gear;

  model Link "Inertia of all that the axis turns"
    Flange flange;
    parameter Real J(unit = "kg.m2", min = 0) = 1000 "Inertia";
    Real phi(start = 0, fixed = true, unit = "rad") "Angle";
    Real w(start = 0, fixed = true, unit = "rad/s") "Speed";
  equation
    phi = flange.phi;
    w = der(phi);
    J*der(w) = flange.tau;
  end Link;

  input Real q(unit = "rad") "Angle of the motor, over the gear ratio";
  input Real w(unit = "rad/s") "Its speed";
  input Real a(unit = "rad/s2") "Its acceleration";
  output Real tau(unit = "N.m") "Torque of the motor";
  output Real q_link(unit = "rad") "Angle of the link";
  Motor motor;
  Gear gear;
  Link link;
equation
  motor.q = q;
  motor.w = w;
  motor.a = a;
  gear.w = w;
  tau = motor.tau;
  q_link = link.phi;
  connect(motor.flange, gear.motor);
  connect(gear.link, link.flange);
end RobotAxis;
