model ShipDrive "Engine, rubber coupling, propeller and hull"
  connector Flange "Rotational"
    Real phi(unit="rad");
    flow Real tau(unit="N.m");
  end Flange;
  connector Slide "Translational"
    Real s(unit="m");
    flow Real f(unit="N");
  end Slide;
  model Engine
    Flange shaft;
    parameter Real J(unit="kg.m2", min=0) = 400 "Inertia";
    input Real tau(unit="N.m");
    Real phi(unit="rad", start=0, fixed=true), w(unit="rad/s", start=0, fixed=true);
  equation
    phi = shaft.phi;
    w = der(phi);
    J*der(w) = shaft.tau + tau;
  end Engine;
  model Coupling
    Flange a, b;
    parameter Real c(unit="N.m/rad", min=0) = 6000 "Stiffness", d(unit="N.m.s/rad", min=0) = 300 "Damping";
    Real twist(unit="rad");
  equation
    twist = a.phi - b.phi;
    a.tau = c*twist + d*der(twist);
    b.tau = -a.tau;
  end Coupling;
  model Propeller
    Flange shaft;
    Slide thrust;
    parameter Real J(unit="kg.m2", min=0) = 900 "Inertia, with water";
    parameter Real Q(unit="N.m.s2/rad2", min=0) = 25 "Torque", q(unit="N.s2/rad", min=0) = 30 "Less with advance";
    parameter Real T(unit="N.s2/rad2", min=0) = 80 "Thrust";
    Real phi(unit="rad", start=0, fixed=true), w(unit="rad/s", start=0, fixed=true);
  equation
    phi = shaft.phi;
    w = der(phi);
    J*der(w) = shaft.tau - Q*w*abs(w) + q*w*der(thrust.s);
    thrust.f = -T*w*abs(w);
  end Propeller;
  model Hull
    Slide bow;
    parameter Real m(unit="kg", min=0) = 3e4 "Mass, with water";
    parameter Real R(unit="N.s2/m2", min=0) = 900 "Resistance", waves(unit="N.s2/m2", min=0) = 4000 "Waves above 4 m/s";
    Real s(unit="m", start=0, fixed=true), U(unit="m/s", start=0, fixed=true);
  equation
    s = bow.s;
    U = der(s);
    m*der(U) = bow.f - R*U*abs(U) - waves*max(U - 4, 0)^2;
  end Hull;
  input Real tau(unit="N.m") "Torque of the engine";
  output Real w_engine(unit="rad/s") "Speed of the engine";
  output Real w_propeller(unit="rad/s") "Speed of the propeller";
  output Real U(unit="m/s") "Log of the ship";
  Engine engine; Coupling coupling; Propeller propeller; Hull hull;
equation
  engine.tau = tau;
  connect(engine.shaft, coupling.a);
  connect(coupling.b, propeller.shaft);
  connect(propeller.thrust, hull.bow);
  w_engine = engine.w;
  w_propeller = propeller.w;
  U = hull.U;
end ShipDrive;
