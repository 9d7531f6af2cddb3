within;
package Written "Models that state their balances as equations"
  model Shaft "A motor that drives a load through an elastic shaft and a gear"
    parameter Real Jm(unit="kg.m2", min=0) = 0.0025;
    parameter Real Jl(unit="kg.m2", min=0) = 0.0045;
    parameter Real k(unit="N.m/rad", min=0) = 12;
    parameter Real c(unit="N.m.s/rad", min=0) = 0.012;
    parameter Real dm(unit="N.m.s/rad", min=0) = 0.012;
    parameter Real dl(unit="N.m.s/rad", min=0) = 0.006;
    parameter Real n = 2;
    input Real tau(unit="N.m");
    output Real w(unit="rad/s", start=0, fixed=true);
    output Real wl(unit="rad/s", start=0, fixed=true);
    Real phi(unit="rad", start=0, fixed=true);
    Real phil(unit="rad", start=0, fixed=true);
    Real T(unit="N.m") = k*twist + c*(w/n - wl);
    Real twist(unit="rad");
  equation
    twist = phi/n - phil;
    der(phi) = w;
    der(phil) = wl;
    Jm*der(w) = tau - dm*w - T/n;
    Jl*der(wl) = T - dl*wl;
  end Shaft;

  model SlackShaft "The same with backlash"
    extends Shaft(T = k*slack + c*der(slack));
    parameter Real gap(unit="rad") = 0.02;
    Real slack(unit="rad") = twist - noEvent(max(min(twist, gap), -gap));
  end SlackShaft;

  model Loudspeaker "A voice coil that moves a cone"
    parameter Real Re(unit="Ohm", min=0.1) = 6;
    parameter Real Le(unit="H", min=1e-5) = 0.5e-3;
    parameter Real Bl(unit="N/A", min=0.1) = 7;
    parameter Real M(unit="kg", min=1e-4) = 0.02;
    parameter Real K(unit="N/m", min=1) = 2500;
    parameter Real R(unit="N.s/m", min=0) = 1.2;
    input Real u(unit="V");
    output Real i(unit="A", start=0, fixed=true);
    output Real x(unit="m", start=0, fixed=true);
    Real v(unit="m/s") = der(x);
    Real a(unit="m/s2") = der(v);
  initial equation
    v = 0;
  equation
    0 = u - Re*i - Bl*v - Le*der(i);
    Bl*i - K*x - R*v - M*a = 0;
  end Loudspeaker;

  model Tanks "Two tanks in a row"
    parameter Real A(unit="m2", min=0) = 0.01;
    parameter Real c(unit="m2/s", min=0) = 2e-4;
    input Real q(unit="m3/s");
    output Real h1(unit="m", start=0.1, fixed=true);
    output Real h2(unit="m", start=0.05, fixed=true);
  equation
    der(h1) = (q - c*(h1 - h2))/A;
    -A*der(h2) = c*h2 - c*(h1 - h2);
  end Tanks;

  model Oven "A heated block in a chamber"
    parameter Real C(unit="J/K", min=1) = 800;
    parameter Real G(unit="W/K", min=0) = 3;
    parameter Real Ta(unit="K") = 293;
    input Real P(unit="W");
    output Real T(unit="K", start=293, fixed=true);
    output Real Tw(unit="K", start=293, fixed=true);
  equation
    C*der(T) = P + G*(Tw - T);
    2*C*der(Tw) = G*(T - Tw) - 2*G*(Tw - Ta);
  end Oven;

  model Cart "A cart with a pendulum, by Lagrange"
    parameter Real M(unit="kg", min=0) = 2;
    parameter Real m(unit="kg", min=0) = 0.3;
    parameter Real l(unit="m", min=0) = 0.5;
    parameter Real d(unit="N.s/m", min=0) = 1;
    parameter Real b(unit="N.m.s/rad", min=0) = 0.01;
    input Real F(unit="N");
    output Real s(unit="m", start=0, fixed=true);
    output Real phi(unit="rad", start=0.1, fixed=true);
    Real v(unit="m/s", start=0, fixed=true) = der(s);
    Real w(unit="rad/s", start=0, fixed=true) = der(phi);
  equation
    (M + m)*der(v) + m*l*cos(phi)*der(w) = F - d*v + m*l*sin(phi)*w^2;
    m*l*cos(phi)*der(v) + m*l^2*der(w) = -b*w - m*9.81*l*sin(phi);
  end Cart;

  model Plain "A mass on a spring, without units"
    parameter Real m = 2;
    parameter Real k = 8;
    parameter Real d = 1;
    input Real F;
    output Real x(start=0, fixed=true);
    Real v(start=0, fixed=true);
  equation
    der(x) = v;
    der(v) = (F - k*x - d*v)/m;
  end Plain;

  model Filtered "A controller and a vehicle whose position nobody asks for"
    block Lag
      parameter Real T(unit="s") = 0.1;
      input Real u(unit="N");
      output Real y(unit="N", start=0, fixed=true);
    equation
      T*der(y) = u - y;
    end Lag;
    parameter Real m(unit="kg", min=0) = 1000;
    parameter Real d(unit="N.s/m", min=0) = 50;
    input Real F(unit="N");
    output Real v(unit="m/s", start=0, fixed=true);
    Lag lag;
  equation
    lag.u = F;
    m*der(v) = lag.y - d*v;
  end Filtered;
  connector Pin
    Real v(unit = "V");
    flow Real i(unit = "A");
  end Pin;

  connector Flange
    Real phi(unit = "rad");
    flow Real tau(unit = "N.m");
  end Flange;

  model Winding "A motor whose other pin is the ground"
    Pin a;
    Flange b;
    parameter Real L(unit = "H") = 0.02;
    parameter Real R(unit = "Ohm") = 1;
    parameter Real k(unit = "N.m/A") = 0.1;
    Real i(unit = "A", start = 0, fixed = true);
  equation
    i = a.i;
    L*der(i) = a.v - R*i - k*der(b.phi);
    b.tau = -k*i;
  end Winding;

  model Supply
    Pin port;
    input Real u(unit = "V");
  equation
    port.v = u;
  end Supply;

  model Rotor
    Flange port;
    parameter Real J(unit = "kg.m2") = 1e-3;
    Real phi(unit = "rad", start = 0, fixed = true);
    Real w(unit = "rad/s", start = 0, fixed = true);
  equation
    phi = port.phi;
    w = der(phi);
    J*der(w) = port.tau;
  end Rotor;

  model Motor
    input Real u(unit = "V");
    output Real w(unit = "rad/s") = rotor.w;
    output Real i(unit = "A") = motor.i;
    Winding motor;
    Rotor rotor;
    Supply supply(u = u);
  equation
    connect(supply.port, motor.a);
    connect(motor.b, rotor.port);
  end Motor;

  connector Slider
    Real s(unit = "m");
    flow Real f(unit = "N");
  end Slider;

  model ElasticScrew "A ball screw that gives way"
    Flange a;
    Slider b;
    parameter Real r(unit = "m/rad") = 0.01;
    parameter Real c(unit = "N/m") = 2e4;
    parameter Real d(unit = "N.s/m") = 40;
    replaceable Real twist(unit = "m") = rel;
    Real rel(unit = "m");
  equation
    rel = r*a.phi - b.s;
    b.f = -(c*twist + d*der(twist));
    a.tau = -r*b.f;
  end ElasticScrew;

  model Table
    Slider port;
    parameter Real m(unit = "kg") = 5;
    parameter Real d(unit = "N.s/m") = 20;
    Real s(unit = "m", start = 0, fixed = true);
    Real v(unit = "m/s", start = 0, fixed = true);
  equation
    s = port.s;
    v = der(s);
    m*der(v) = port.f - d*v;
  end Table;

  model Drive
    Flange port;
    input Real tau(unit = "N.m");
  equation
    port.tau = -tau;
  end Drive;

  model Screw "A motor and a table with a screw between them"
    input Real tau(unit = "N.m");
    output Real w(unit = "rad/s") = rotor.w;
    output Real v(unit = "m/s") = table.v;
    Drive drive(tau = tau);
    Rotor rotor;
    ElasticScrew screw;
    Table table;
  equation
    connect(drive.port, rotor.port);
    connect(rotor.port, screw.a);
    connect(screw.b, table.port);
  end Screw;

  model SlackScrew "The same with backlash"
    extends Screw(screw(twist = screw.rel - noEvent(max(min(screw.rel, gap), -gap))));
    parameter Real gap(unit = "m") = 1e-4;
  end SlackScrew;

  model Carriage "The same as equations"
    parameter Real J(unit = "kg.m2", min = 0) = 1e-3;
    parameter Real m(unit = "kg", min = 0) = 5;
    parameter Real r(unit = "m/rad") = 0.01;
    parameter Real c(unit = "N/m", min = 0) = 2e4;
    parameter Real d(unit = "N.s/m", min = 0) = 40;
    parameter Real dv(unit = "N.s/m", min = 0) = 20;
    input Real tau(unit = "N.m");
    output Real w(unit = "rad/s", start = 0, fixed = true) = der(phi);
    output Real v(unit = "m/s", start = 0, fixed = true) = der(s);
    Real phi(unit = "rad", start = 0, fixed = true);
    Real s(unit = "m", start = 0, fixed = true);
    Real f(unit = "N") = c*(r*phi - s) + d*(r*der(phi) - der(s));
  equation
    J*der(w) = tau - r*f;
    m*der(v) = f - dv*v;
  end Carriage;
end Written;
