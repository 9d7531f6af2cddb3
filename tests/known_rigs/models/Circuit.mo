model Circuit "An amplifier drives a damped resonant circuit"
  connector Pin
    Real v(unit="V");
    flow Real i(unit="A");
  end Pin;
  model Source
    Pin p, n;
    input Real v(unit="V");
  equation
    p.v - n.v = v;
    p.i + n.i = 0;
  end Source;
  model Resistor
    Pin p, n;
    parameter Real R(unit="Ohm", min=0) = 20;
  equation
    p.v - n.v = R*p.i;
    p.i + n.i = 0;
  end Resistor;
  model Inductor
    Pin p, n;
    parameter Real L(unit="H", min=0) = 0.02;
    Real i(unit="A", start=0, fixed=true);
  equation
    i = p.i;
    L*der(i) = p.v - n.v;
    p.i + n.i = 0;
  end Inductor;
  model Capacitor
    Pin p, n;
    parameter Real C(unit="F", min=0) = 5e-6;
    Real v(unit="V", start=0, fixed=true);
  equation
    v = p.v - n.v;
    C*der(v) = p.i;
    p.i + n.i = 0;
  end Capacitor;
  model Ground
    Pin p;
  equation
    p.v = 0;
  end Ground;
  input Real u(unit="V") "Amplifier";
  output Real v(unit="V") "Voltage of the capacitor";
  output Real i(unit="A") "Current through the shunt";
  Source source; Resistor resistor; Inductor inductor; Capacitor capacitor; Ground ground;
equation
  source.v = u;
  connect(source.p, resistor.p);
  connect(resistor.n, inductor.p);
  connect(inductor.n, capacitor.p);
  connect(capacitor.n, ground.p);
  connect(source.n, ground.p);
  v = capacitor.v;
  i = inductor.i;
end Circuit;
