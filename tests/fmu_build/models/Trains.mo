package Trains "Rotating trains with known solutions"
  type Angle = Real(final quantity = "Angle", final unit = "rad", displayUnit = "deg");
  type AngularVelocity = Real(final unit = "rad/s");
  type Torque = Real(final unit = "N.m");

  connector Flange
    Angle phi;
    flow Torque tau;
  end Flange;

  partial model TwoFlanges
    Flange a;
    Flange b;
  end TwoFlanges;

  model Inertia
    extends TwoFlanges;
    parameter Real J(unit = "kg.m2", min = 0, start = 1);
    parameter StateSelect select = StateSelect.default;
    Angle phi(stateSelect = select);
    AngularVelocity w(stateSelect = select);
    Real acc(unit = "rad/s2");
  equation
    phi = a.phi;
    phi = b.phi;
    w = der(phi);
    acc = der(w);
    J*acc = a.tau + b.tau;
  end Inertia;

  model SpringDamper
    extends TwoFlanges;
    parameter Real c(unit = "N.m/rad") = 100;
    parameter Real d(unit = "N.m.s/rad") = 0;
    Angle phi_rel;
    AngularVelocity w_rel;
    Torque tau;
  equation
    phi_rel = b.phi - a.phi;
    w_rel = der(phi_rel);
    tau = c*phi_rel + d*w_rel;
    b.tau = tau;
    a.tau = -tau;
  end SpringDamper;

  model Fixed
    Flange flange;
  equation
    flange.phi = 0;
  end Fixed;

  model Torque_ "External torque"
    Flange flange;
    input Torque tau;
  equation
    flange.tau = -tau;
  end Torque_;

  model Motor "Torque between stator and rotor"
    Flange stator;
    Flange rotor;
    Torque tau;
  equation
    rotor.tau = -tau;
    stator.tau = tau;
  end Motor;

  model IdealGear
    extends TwoFlanges;
    parameter Real ratio = 3;
  equation
    a.phi = ratio*b.phi;
    0 = ratio*a.tau + b.tau;
  end IdealGear;

  model Planetary "Carrier, sun and ring: phi_W = (1 - n) phi_C + n phi_F"
    Flange W;
    Flange C;
    Flange F;
    parameter Real n = 50;
  equation
    W.phi = (1 - n)*C.phi + n*F.phi;
    F.tau = -n*W.tau;
    C.tau = (n - 1)*W.tau;
  end Planetary;

  model Oscillator
    SpringDamper spring(c = 400);
    Inertia mass(J = 4, phi(start = 0.1, fixed = true), w(start = 0, fixed = true));
    Fixed fixed;
    output Angle y = mass.phi;
  equation
    connect(fixed.flange, spring.a);
    connect(spring.b, mass.a);
  end Oscillator;

  model TwoMass "Free oscillation between two inertias, driven by a torque"
    Inertia one(J = 1, phi(start = 0, fixed = true), w(start = 0, fixed = true));
    Inertia two(J = 3, phi(start = 0.2, fixed = true), w(start = 0, fixed = true));
    SpringDamper spring(c = 300, d = 0.5);
    Torque_ drive;
    input Torque u;
    output AngularVelocity w1 = one.w;
    output AngularVelocity w2 = two.w;
  equation
    drive.tau = u;
    connect(drive.flange, one.a);
    connect(one.b, spring.a);
    connect(spring.b, two.a);
  end TwoMass;

  model Rigid "Two inertias coupled rigidly: index 3, two states"
    Inertia one(J = 1, phi(start = 0, fixed = true), w(start = 0, fixed = true));
    Inertia two(J = 2, select = StateSelect.prefer);
    Torque_ drive;
    input Torque u;
    output AngularVelocity w = two.w;
    output Torque cut = two.a.tau;
  equation
    drive.tau = u;
    connect(drive.flange, one.a);
    connect(one.b, two.a);
  end Rigid;

  model Geared
    Inertia motor(J = 0.1);
    Inertia load(J = 2, phi(start = 0.5, fixed = true), w(start = 0, fixed = true));
    IdealGear gear(ratio = 10);
    Torque_ drive;
    input Torque u;
    output AngularVelocity w_motor = motor.w;
    output AngularVelocity w_load = load.w;
  equation
    drive.tau = u;
    connect(drive.flange, motor.a);
    connect(motor.b, gear.a);
    connect(gear.b, load.a);
  end Geared;

  model Pendulum
    constant Real g = 9.81;
    parameter Real m = 2;
    parameter Real l = 0.5;
    parameter Angle phi0 = 2.5;
    Angle phi(start = phi0, fixed = true);
    AngularVelocity w(start = 0, fixed = true);
    output Real energy(unit = "J");
  equation
    w = der(phi);
    m*l^2*der(w) = -m*g*l*sin(phi);
    energy = m*l^2*w^2/2 + m*g*l*(1 - cos(phi));
  end Pendulum;

  model Actuator "Housing on a sensor, motor, Harmonic Drive with springs, free load: 6 + 2 states less 0"
    parameter Real n = 50;
    SpringDamper sensor(c = 1.3e5, d = 2.66);
    Inertia housing(J = 3.0e-3);
    Inertia rotor(J = 2.0e-4);
    Planetary gear(n = n);
    SpringDamper flexspline(c = 25500, d = 70.6);
    Motor motor;
    Inertia load(J = 0.05);
    Inertia plate(J = 0.01);
    Fixed console;
    input Real i(unit = "A");
    output Torque tau_sensor = -sensor.tau;
    output AngularVelocity w_motor = rotor.w - housing.w;
  equation
    connect(console.flange, sensor.a);
    connect(sensor.b, housing.a);
    connect(housing.b, gear.C);
    connect(rotor.b, gear.W);
    connect(motor.rotor, rotor.a);
    connect(motor.stator, housing.b);
    motor.tau = 0.7*i;
    connect(gear.F, flexspline.a);
    connect(flexspline.b, load.a);
    connect(load.b, plate.a);
  end Actuator;

  model Crank "A constraint whose Jacobian varies: the angle is told to stay a state"
    parameter Real r = 0.1;
    parameter Real l = 0.3;
    parameter Real m = 2;
    parameter Real J = 0.01;
    Angle phi(start = 0.7, fixed = true, stateSelect = StateSelect.always);
    AngularVelocity w(start = 3, fixed = true, stateSelect = StateSelect.always);
    Real s(start = 0.37);
    Real v;
    Real F "Force of the piston on the rod, multiplier of the constraint";
    output Real energy = J*w^2/2 + m*v^2/2;
  equation
    w = der(phi);
    v = der(s);
    m*v_dot = -F;
    v_dot = der(v);
    J*der(w) = F*(-r*sin(phi) - r^2*sin(phi)*cos(phi)/sqrt(l^2 - r^2*sin(phi)^2));
    s = r*cos(phi) + sqrt(l^2 - r^2*sin(phi)^2);
  protected
    Real v_dot;
  end Crank;

  model Cartesian "A pendulum in Cartesian coordinates: no two of its variables are states in every position"
    Real x(start = 0.6, fixed = true);
    Real y(start = 0.8);
    Real vx(start = 0, fixed = true);
    Real vy, F;
  equation
    der(x) = vx;
    der(y) = vy;
    der(vx) = -F*x;
    der(vy) = -F*y - 9.81;
    x^2 + y^2 = 1;
  end Cartesian;

  model Sticks "The same, by its angle"
    Real phi(start = acos(-0.8), fixed = true);
    Real w(start = 0, fixed = true) = der(phi);
    Real x = sin(phi);
    Real y = -cos(phi);
    Real vx = der(x);
    Real vy = der(y);
    Real F;
  equation
    der(vx) = -F*x;
    der(vy) = -F*y - 9.81;
  end Sticks;

  model Chosen "The same for small angles, by states that the modeller chose"
    extends Cartesian(x(stateSelect = StateSelect.always), vx(stateSelect = StateSelect.always), y(start = -0.8));
  end Chosen;
end Trains;
