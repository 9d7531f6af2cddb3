package Rectifier "A bridge of ideal diodes behind a switch and a transformer, all piecewise linear"
  connector Pin
    Real v;
    flow Real i;
  end Pin;

  partial model TwoPins
    Pin p, n;
    Real v, i;
  equation
    v = p.v - n.v;
    i = p.i;
    0 = p.i + n.i;
  end TwoPins;

  model Diode
    extends TwoPins;
    parameter Real Ron = 1e-5, Goff = 1e-5, Vknee = 0;
    Boolean off(start = true);
    Real s(start = 0);
  equation
    off = s < 0;
    v = s*(if off then 1 else Ron) + Vknee;
    i = s*(if off then Goff else 1) + Goff*Vknee;
  end Diode;

  model Switch
    extends TwoPins;
    parameter Real Ron = 1e-5, Goff = 0;
    input Boolean control;
    Real s;
  equation
    v = s*(if control then Ron else 1);
    i = s*(if control then 1 else Goff);
  end Switch;

  model Transformer
    Pin p1, n1, p2, n2;
    parameter Real n = 10;
  equation
    p1.i + n1.i = 0;
    p2.i + n2.i = 0;
    p1.v - n1.v = n*(p2.v - n2.v);
    p2.i = -n*p1.i;
  end Transformer;

  model Wall
    extends TwoPins;
    parameter Real V = 120, f = 60;
  equation
    v = V*sin(2*3.141592653589793*f*time);
  end Wall;

  model Ground
    Pin p;
  equation
    p.v = 0;
  end Ground;

  model Capacitor
    extends TwoPins(v(start = 0, fixed = true));
    parameter Real C = 1e-2;
  equation
    C*der(v) = i;
  end Capacitor;

  model Resistor
    extends TwoPins;
    parameter Real R = 100;
  equation
    v = R*i;
  end Resistor;

  model PowerSupply
    Wall wall;
    Switch switch;
    Transformer transformer;
    Diode d1, d2, d3, d4;
    Capacitor capacitor;
    Resistor load;
    Ground ground;
    output Real v = load.v "Rectified voltage";
    output Real i = wall.i "Current from the wall";
  equation
    switch.control = time >= 0.01;
    connect(wall.p, switch.p);
    connect(switch.n, transformer.p1);
    connect(wall.n, transformer.n1);
    connect(wall.n, ground.p);
    connect(transformer.n2, ground.p);
    connect(transformer.p2, d1.n);
    connect(d1.n, d2.p);
    connect(transformer.n2, d3.n);
    connect(d3.n, d4.p);
    connect(d1.p, d3.p);
    connect(d1.p, capacitor.n);
    connect(load.n, capacitor.n);
    connect(d2.n, d4.n);
    connect(d2.n, load.p);
    connect(load.p, capacitor.p);
  end PowerSupply;
end Rectifier;
