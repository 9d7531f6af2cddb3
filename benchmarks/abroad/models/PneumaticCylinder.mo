model PneumaticCylinder "A valve fills a chamber whose piston works against a spring"
  connector Opening
    Real p(unit="Pa") "Above that of the surroundings";
    flow Real q(unit="m3/s");
  end Opening;
  connector Slide "Translational"
    Real s(unit="m");
    flow Real f(unit="N");
  end Slide;
  model Valve
    Opening port;
    parameter Real k(unit="m3/(s.V)", min=0) = 1e-4 "Flow by voltage";
    input Real u(unit="V");
  equation
    port.q = -k*u;
  end Valve;
  model Chamber
    Opening port;
    parameter Real C(unit="m3/Pa", min=0) = 1.5e-9 "Volume by pressure";
    Real p(unit="Pa", start=0, fixed=true);
  equation
    p = port.p;
    C*der(p) = port.q;
  end Chamber;
  model Throttle "To the surroundings"
    Opening port;
    parameter Real G(unit="m3/(s.Pa)", min=0) = 2e-9;
  equation
    port.q = G*port.p;
  end Throttle;
  model Cylinder
    Opening port;
    Slide rod;
    parameter Real A(unit="m2", min=0) = 1.2e-3 "Area of the piston";
  equation
    port.q = A*der(rod.s);
    rod.f = -A*port.p;
  end Cylinder;
  model Piston
    Slide rod;
    parameter Real m(unit="kg", min=0) = 2 "Mass";
    parameter Real d(unit="N.s/m", min=0) = 60 "Viscous friction", F(unit="N", min=0) = 8 "Dry friction";
    Real s(unit="m", start=0, fixed=true), v(unit="m/s", start=0, fixed=true);
  equation
    s = rod.s;
    v = der(s);
    m*der(v) = rod.f - d*v - F*tanh(v/0.01);
  end Piston;
  model Springs "Return spring, and cushions at the ends"
    Slide rod;
    parameter Real c(unit="N/m", min=0) = 2500 "Of the spring", cushion(unit="N/m", min=0) = 8000 "Of the cushions";
  equation
    rod.f = c*rod.s + cushion*(max(rod.s - 0.06, 0) + min(rod.s + 0.06, 0));
  end Springs;
  input Real u(unit="V") "Valve";
  output Real p(unit="Pa") "Pressure in the chamber";
  output Real s(unit="m") "Position of the piston";
  Valve valve; Chamber chamber; Throttle throttle; Cylinder cylinder; Piston piston; Springs springs;
equation
  valve.u = u;
  connect(valve.port, chamber.port);
  connect(throttle.port, chamber.port);
  connect(cylinder.port, chamber.port);
  connect(cylinder.rod, piston.rod);
  connect(springs.rod, piston.rod);
  p = chamber.p;
  s = piston.s;
end PneumaticCylinder;
