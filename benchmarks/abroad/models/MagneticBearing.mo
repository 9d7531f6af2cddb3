model MagneticBearing "A rotor between two magnets, held by its controller"
  connector Slide "Translational"
    Real s(unit="m");
    flow Real f(unit="N");
  end Slide;
  connector Pin
    Real v(unit="V");
    flow Real i(unit="A");
  end Pin;
  model Controller "Voltage by position and its rate"
    Pin p, n;
    parameter Real kp(unit="V/m") = 3e4, kd(unit="V.s/m") = 30;
    input Real r(unit="m"), x(unit="m");
  equation
    p.v - n.v = kp*(r - x) - kd*der(x);
    p.i + n.i = 0;
  end Controller;
  model Magnets "Two in opposition, with a bias current"
    Pin p, n;
    Slide gap;
    parameter Real k(unit="N.m2/A2", min=0) = 8e-6 "Force constant";
    parameter Real R(unit="Ohm", min=0) = 2, L(unit="H", min=0) = 1e-3;
    constant Real bias(unit="A") = 2, air(unit="m") = 4e-4;
    Real i(unit="A", start=0, fixed=true);
  equation
    i = p.i;
    p.i + n.i = 0;
    L*der(i) = p.v - n.v - R*i;
    gap.f = -k*(((bias + i)/(air - gap.s))^2 - ((bias - i)/(air + gap.s))^2);
  end Magnets;
  model Rotor
    Slide axis;
    parameter Real m(unit="kg", min=0) = 3 "Mass", touch(unit="N/m", min=0) = 3e5 "Of the touch-down bearing";
    Real x(unit="m", start=0, fixed=true), v(unit="m/s", start=0, fixed=true);
  equation
    x = axis.s;
    v = der(x);
    m*der(v) = axis.f - touch*(max(x - 6e-5, 0) + min(x + 6e-5, 0));
  end Rotor;
  model Ground
    Pin p;
  equation
    p.v = 0;
  end Ground;
  input Real r(unit="m") "Reference";
  output Real x(unit="m") "Eddy current sensor";
  output Real i(unit="A") "Control current";
  Controller controller; Magnets magnets; Rotor rotor; Ground ground;
equation
  controller.r = r;
  controller.x = rotor.x;
  connect(controller.p, magnets.p);
  connect(controller.n, ground.p);
  connect(magnets.n, ground.p);
  connect(magnets.gap, rotor.axis);
  x = rotor.x;
  i = magnets.i;
end MagneticBearing;
