model GantryCrane "A trolley on rails with a payload that swings below it"
  connector Slide "Translational"
    Real s(unit="m");
    flow Real f(unit="N");
  end Slide;
  model Drive
    Slide belt;
    parameter Real k(unit="N/V") = 30 "Force by voltage";
    input Real u(unit="V");
  equation
    belt.f = -k*u;
  end Drive;
  model Trolley
    Slide rail;
    parameter Real M(unit="kg", min=0) = 12 "Mass";
    parameter Real d(unit="N.s/m", min=0) = 25 "Viscous friction", F(unit="N", min=0) = 6 "Dry friction";
    Real s(unit="m", start=0, fixed=true), v(unit="m/s", start=0, fixed=true);
  equation
    s = rail.s;
    v = der(s);
    M*der(v) = rail.f - d*v - F*tanh(v/0.01);
  end Trolley;
  model Payload "Hangs on a rope"
    Slide hook;
    parameter Real m(unit="kg", min=0) = 5 "Mass", L(unit="m", min=0) = 0.8 "Length of the rope";
    parameter Real b(unit="1/s", min=0) = 0.15 "Damping of the swing";
    Real theta(unit="rad", start=0, fixed=true), w(unit="rad/s", start=0, fixed=true), v(unit="m/s");
  equation
    v = der(hook.s);
    w = der(theta);
    L*der(w) + der(v)*cos(theta) + 9.81*sin(theta) + L*b*w = 0;
    hook.f = m*(der(v) + L*der(w)*cos(theta) - L*w^2*sin(theta));
  end Payload;
  model Buffer "At both ends of the rails"
    Slide contact;
    parameter Real c(unit="N/m", min=0) = 400 "Stiffness";
    constant Real reach(unit="m") = 1.5;
  equation
    contact.f = c*(max(contact.s - reach, 0) + min(contact.s + reach, 0));
  end Buffer;
  input Real u(unit="V") "Amplifier of the drive";
  output Real s(unit="m") "Position of the trolley";
  output Real theta(unit="rad") "Angle of the rope";
  Drive drive; Trolley trolley; Payload payload; Buffer buffer;
equation
  drive.u = u;
  connect(drive.belt, trolley.rail);
  connect(trolley.rail, payload.hook);
  connect(trolley.rail, buffer.contact);
  s = trolley.s;
  theta = payload.theta;
end GantryCrane;
