model BeltAxis "A motor moves a carriage by a toothed belt"
  connector Flange "Rotational"
    Real phi(unit="rad");
    flow Real tau(unit="N.m");
  end Flange;
  connector Slide "Translational"
    Real s(unit="m");
    flow Real f(unit="N");
  end Slide;
  model Motor
    Flange shaft;
    parameter Real k(unit="N.m/A") = 0.12 "Torque constant";
    input Real i(unit="A");
  equation
    shaft.tau = -k*i;
  end Motor;
  model Rotor
    Flange shaft;
    parameter Real J(unit="kg.m2", min=0) = 1.2e-4 "Inertia";
    Real phi(unit="rad", start=0, fixed=true), w(unit="rad/s", start=0, fixed=true);
  equation
    phi = shaft.phi;
    w = der(phi);
    J*der(w) = shaft.tau;
  end Rotor;
  model Pulley
    Flange shaft;
    Slide rim;
    parameter Real r(unit="m") = 0.02 "Radius";
  equation
    rim.s = r*shaft.phi;
    shaft.tau = -r*rim.f;
  end Pulley;
  model Belt
    Slide a, b;
    parameter Real c(unit="N/m", min=0) = 6e4 "Stiffness", d(unit="N.s/m", min=0) = 40 "Damping";
    Real stretch(unit="m");
  equation
    stretch = b.s - a.s;
    b.f = c*stretch + d*der(stretch);
    a.f = -b.f;
  end Belt;
  model Carriage
    Slide rail;
    parameter Real m(unit="kg", min=0) = 1.5 "Mass";
    parameter Real d(unit="N.s/m", min=0) = 4 "Viscous friction", F(unit="N", min=0) = 3 "Dry friction";
    Real s(unit="m", start=0, fixed=true), v(unit="m/s", start=0, fixed=true);
  equation
    s = rail.s;
    v = der(s);
    m*der(v) = rail.f - d*v - F*tanh(v/0.005);
  end Carriage;
  input Real i(unit="A") "Current";
  output Real phi(unit="rad") "Encoder of the motor";
  output Real s(unit="m") "Linear scale of the carriage";
  Motor motor; Rotor rotor; Pulley pulley; Belt belt; Carriage carriage;
equation
  motor.i = i;
  connect(motor.shaft, rotor.shaft);
  connect(rotor.shaft, pulley.shaft);
  connect(pulley.rim, belt.a);
  connect(belt.b, carriage.rail);
  phi = rotor.phi;
  s = carriage.s;
end BeltAxis;
