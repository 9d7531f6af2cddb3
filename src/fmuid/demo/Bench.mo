package Bench "A motor, a shaft and a load: the model of `fmuid demo`"
  connector Flange
    Real phi(unit = "rad");
    flow Real tau(unit = "N.m");
  end Flange;

  model Inertia
    Flange a;
    Flange b;
    parameter Real J(unit = "kg.m2") "Moment of inertia";
    Real phi(unit = "rad", start = 0, fixed = true);
    Real w(unit = "rad/s", start = 0, fixed = true);
  equation
    a.phi = phi;
    b.phi = phi;
    w = der(phi);
    J*der(w) = a.tau + b.tau;
  end Inertia;

  model Shaft
    Flange a;
    Flange b;
    parameter Real c(unit = "N.m/rad") = 12 "Stiffness";
    parameter Real d(unit = "N.m.s/rad") = 0.02 "Damping";
    Real phi_rel(unit = "rad");
  equation
    phi_rel = b.phi - a.phi;
    b.tau = c*phi_rel + d*der(phi_rel);
    a.tau = -b.tau;
  end Shaft;

  model Motor
    Flange shaft;
    input Real tau(unit = "N.m");
  equation
    shaft.tau = -tau;
  end Motor;

  model Drive "A motor turns a load through a shaft that is a little soft"
    input Real tau(unit = "N.m", start = 0) "Torque of the motor";
    output Real w_motor(unit = "rad/s") "Speed of the motor";
    output Real w_load(unit = "rad/s") "Speed of the load";
    Motor motor;
    Inertia rotor(J = 2.5e-3);
    Shaft shaft;
    Inertia load(J = 4e-3);
  equation
    motor.tau = tau;
    connect(motor.shaft, rotor.a);
    connect(rotor.b, shaft.a);
    connect(shaft.b, load.a);
    w_motor = rotor.w;
    w_load = load.w;
  end Drive;
end Bench;
