model BuckConverter "Averaged over its switching"
  connector Pin
    Real v(unit="V");
    flow Real i(unit="A");
  end Pin;
  model Switch "Duty times the supply"
    Pin p, n;
    parameter Real V(unit="V", min=0) = 24 "Supply";
    input Real duty(unit="1");
  equation
    p.v - n.v = duty*V;
    p.i + n.i = 0;
  end Switch;
  model Choke
    Pin p, n;
    parameter Real L(unit="H", min=0) = 1e-3, R(unit="Ohm", min=0) = 0.3;
    Real i(unit="A", start=0, fixed=true);
  equation
    i = p.i;
    p.i + n.i = 0;
    L*der(i) = p.v - n.v - R*i;
  end Choke;
  model Capacitor
    Pin p, n;
    parameter Real C(unit="F", min=0) = 2e-4;
    Real v(unit="V", start=0, fixed=true);
  equation
    v = p.v - n.v;
    C*der(v) = p.i;
    p.i + n.i = 0;
  end Capacitor;
  model Load
    Pin p, n;
    parameter Real R(unit="Ohm", min=0) = 6;
  equation
    p.v - n.v = R*p.i;
    p.i + n.i = 0;
  end Load;
  model Clamp "Conducts above 17 V"
    Pin p, n;
    parameter Real G(unit="S", min=0) = 0.8;
  equation
    p.i = G*max(p.v - n.v - 17, 0);
    p.i + n.i = 0;
  end Clamp;
  model Ground
    Pin p;
  equation
    p.v = 0;
  end Ground;
  input Real duty(unit="1") "Duty of the switch";
  output Real v(unit="V") "At the load";
  output Real i(unit="A") "Through the choke";
  Switch bridge; Choke choke; Capacitor capacitor; Load load; Clamp clamp; Ground ground;
equation
  bridge.duty = duty;
  connect(bridge.p, choke.p);
  connect(choke.n, capacitor.p);
  connect(capacitor.p, load.p);
  connect(capacitor.p, clamp.p);
  connect(capacitor.n, ground.p);
  connect(load.n, ground.p);
  connect(clamp.n, ground.p);
  connect(bridge.n, ground.p);
  v = capacitor.v;
  i = choke.i;
end BuckConverter;
