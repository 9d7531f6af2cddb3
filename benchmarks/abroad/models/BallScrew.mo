model BallScrew "A motor moves a table by a screw whose nut gives way"
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
    parameter Real k(unit="N.m/A") = 0.3 "Torque constant";
    input Real i(unit="A");
  equation
    shaft.tau = -k*i;
  end Motor;
  model Screw "With the rotor"
    Flange shaft;
    Slide thread;
    parameter Real J(unit="kg.m2", min=0) = 4e-4 "Inertia", d(unit="N.m.s/rad", min=0) = 2e-3 "Viscous friction";
    constant Real lead(unit="m") = 0.01 "By turn";
    Real phi(unit="rad", start=0, fixed=true), w(unit="rad/s", start=0, fixed=true);
  equation
    phi = shaft.phi;
    w = der(phi);
    thread.s = lead/(2*3.141592653589793)*phi;
    J*der(w) = shaft.tau - d*w + lead/(2*3.141592653589793)*thread.f;
  end Screw;
  model Nut
    Slide a, b;
    parameter Real c(unit="N/m", min=0) = 4e6 "Stiffness", d(unit="N.s/m", min=0) = 3000 "Damping";
    Real stretch(unit="m");
  equation
    stretch = b.s - a.s;
    b.f = c*stretch + d*der(stretch);
    a.f = -b.f;
  end Nut;
  model Table
    Slide guide;
    parameter Real m(unit="kg", min=0) = 40 "Mass";
    parameter Real d(unit="N.s/m", min=0) = 200 "Viscous friction", F(unit="N", min=0) = 40 "Dry friction";
    parameter Real stop(unit="N/m", min=0) = 2e4 "Stiffness of the rubber stops";
    Real s(unit="m", start=0, fixed=true), v(unit="m/s", start=0, fixed=true);
  equation
    s = guide.s;
    v = der(s);
    m*der(v) = guide.f - d*v - F*tanh(v/0.002) - stop*(max(s - 0.06, 0) + min(s + 0.06, 0));
  end Table;
  input Real i(unit="A") "Current of the motor";
  output Real phi(unit="rad") "Encoder of the motor";
  output Real s(unit="m") "Glass scale of the table";
  Motor motor; Screw screw; Nut nut; Table table;
equation
  motor.i = i;
  connect(motor.shaft, screw.shaft);
  connect(screw.thread, nut.a);
  connect(nut.b, table.guide);
  phi = screw.phi;
  s = table.s;
end BallScrew;
