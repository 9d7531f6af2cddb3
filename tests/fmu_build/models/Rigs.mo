package Rigs "Plain models of rigs that are no actuator"
  connector Flange
    Real phi(unit = "rad");
    flow Real tau(unit = "N.m");
  end Flange;
  connector Pin
    Real v(unit = "V");
    flow Real i(unit = "A");
  end Pin;
  connector HeatPort
    Real T(unit = "K");
    flow Real Q(unit = "W");
  end HeatPort;
  connector Opening
    Real h(unit = "m");
    flow Real q(unit = "m3/s");
  end Opening;

  model Inertia
    Flange a;
    Flange b;
    parameter Real J(unit = "kg.m2");
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
    parameter Real c(unit = "N.m/rad") = 50;
    parameter Real d(unit = "N.m.s/rad") = 0.01;
    Real phi_rel(unit = "rad");
  equation
    phi_rel = b.phi - a.phi;
    b.tau = c*phi_rel + d*der(phi_rel);
    a.tau = -b.tau;
  end Shaft;
  model Gear
    Flange a;
    Flange b;
    parameter Real ratio = 3;
  equation
    a.phi = ratio*b.phi;
    0 = ratio*a.tau + b.tau;
  end Gear;
  model Drive
    Flange shaft;
    input Real tau(unit = "N.m");
  equation
    shaft.tau = -tau;
  end Drive;
  model TwoMass "Two inertias and a shaft"
    input Real tau(unit = "N.m", start = 0);
    output Real w_motor(unit = "rad/s");
    output Real w_load(unit = "rad/s");
    Drive motor;
    Inertia rotor(J = 2e-3);
    Shaft shaft;
    Inertia load(J = 5e-3);
  equation
    motor.tau = tau;
    connect(motor.shaft, rotor.a);
    connect(rotor.b, shaft.a);
    connect(shaft.b, load.a);
    w_motor = rotor.w;
    w_load = load.w;
  end TwoMass;
  model Relative "The same with the twist as a state, as the Standard Library's SpringDamper has it"
    extends TwoMass(shaft(phi_rel(stateSelect = StateSelect.prefer)));
  end Relative;
  model Dashpot "Damping that depends on speed as the rows of a table say"
    Flange a;
    parameter Real table[3, 2] = [0, 1e-3; 10, 1e-3; 20, 1e-3] "Rows of speed in rad/s and damping in N.m.s/rad";
    parameter Real least(unit = "N.m.s/rad") = 2*0.5e-3;
    Real w(unit = "rad/s");
  equation
    w = der(a.phi);
    a.tau = w*(least + table[1, 2] + (table[2, 2] - table[1, 2])*min(1, abs(w)/table[2, 1])
      + (table[3, 2] - table[2, 2])*max(0, min(1, (abs(w) - table[2, 1])/(table[3, 1] - table[2, 1]))));
  end Dashpot;
  model Damped "The same with damping by a table"
    extends TwoMass;
    parameter Real table[3, 2] = [0, 1e-3; 10, 1e-3; 20, 1e-3];
    Dashpot dashpot(table = table);
  equation
    connect(load.b, dashpot.a);
  end Damped;
  model Geared "A gear between two inertias"
    extends TwoMass;
    output Real tau_table(unit = "N.m");
    Gear gear;
    Inertia table(J = 1e-2, phi(fixed = false), w(fixed = false));
  equation
    connect(load.b, gear.a);
    connect(gear.b, table.a);
    tau_table = gear.b.tau;
  end Geared;

  model Resistor
    Pin p;
    Pin n;
    parameter Real R(unit = "Ohm") = 10;
  equation
    p.v - n.v = R*p.i;
    p.i + n.i = 0;
  end Resistor;
  model Inductor
    Pin p;
    Pin n;
    parameter Real L(unit = "H") = 1e-2;
    Real i(unit = "A", start = 0, fixed = true);
  equation
    i = p.i;
    L*der(i) = p.v - n.v;
    p.i + n.i = 0;
  end Inductor;
  model Capacitor
    Pin p;
    Pin n;
    parameter Real C(unit = "F") = 1e-4;
    Real v(unit = "V", start = 0, fixed = true);
  equation
    v = p.v - n.v;
    C*der(v) = p.i;
    p.i + n.i = 0;
  end Capacitor;
  model Source
    Pin p;
    Pin n;
    input Real v(unit = "V");
  equation
    p.v - n.v = v;
    p.i + n.i = 0;
  end Source;
  model Ground
    Pin p;
  equation
    p.v = 0;
  end Ground;
  model Circuit "Resistor, inductor and capacitor in series"
    input Real v(unit = "V", start = 0);
    output Real v_c(unit = "V");
    Source source;
    Resistor resistor;
    Inductor inductor;
    Capacitor capacitor;
    Ground ground;
  equation
    source.v = v;
    connect(source.p, resistor.p);
    connect(resistor.n, inductor.p);
    connect(inductor.n, capacitor.p);
    connect(capacitor.n, ground.p);
    connect(source.n, ground.p);
    v_c = capacitor.v;
  end Circuit;

  model Mass
    HeatPort port;
    parameter Real C(unit = "J/K") = 500;
    Real T(unit = "K", start = 293, fixed = true);
  equation
    T = port.T;
    C*der(T) = port.Q;
  end Mass;
  model Wall
    HeatPort a;
    HeatPort b;
    parameter Real G(unit = "W/K") = 2;
  equation
    a.Q = G*(a.T - b.T);
    a.Q + b.Q = 0;
  end Wall;
  model Heater
    HeatPort port;
    input Real P(unit = "W");
  equation
    port.Q = -P;
  end Heater;
  model Block "A heated block and a sink"
    input Real P(unit = "W", start = 0);
    output Real T(unit = "K");
    Heater heater;
    Mass body;
    Wall wall;
    Mass sink(C = 3000);
  equation
    heater.P = P;
    connect(heater.port, body.port);
    connect(body.port, wall.a);
    connect(wall.b, sink.port);
    T = body.T;
  end Block;

  model Tank
    Opening bottom;
    parameter Real A(unit = "m2") = 0.1;
    Real h(unit = "m", start = 0.5, fixed = true);
  equation
    bottom.h = h;
    A*der(h) = bottom.q;
  end Tank;
  model Pipe
    Opening a;
    Opening b;
    parameter Real k(unit = "m2/s") = 2e-3;
  equation
    a.q = k*(a.h - b.h);
    a.q + b.q = 0;
  end Pipe;
  model Pump
    Opening port;
    input Real q(unit = "m3/s");
  equation
    port.q = -q;
  end Pump;
  model Tanks "Two tanks and a pipe"
    input Real q(unit = "m3/s", start = 0);
    output Real level(unit = "m");
    Pump pump;
    Tank upper;
    Pipe pipe;
    Tank lower(h(start = 0.2));
  equation
    pump.q = q;
    connect(pump.port, upper.bottom);
    connect(upper.bottom, pipe.a);
    connect(pipe.b, lower.bottom);
    level = lower.h;
  end Tanks;
end Rigs;
