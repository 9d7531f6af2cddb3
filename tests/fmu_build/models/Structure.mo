package Structure "Arrays of components, records, if-equations, conditional parts"
  connector Pin
    Real v(unit = "V");
    flow Real i(unit = "A");
  end Pin;

  record Data
    parameter Real R(unit = "Ohm") = 10;
    parameter Real C[2] = {1e-3, 2e-3};
  end Data;

  record Point
    Real x;
    Real y;
  end Point;

  function rotate
    input Point p;
    input Real angle;
    output Point q;
  algorithm
    q.x := cos(angle)*p.x - sin(angle)*p.y;
    q.y := sin(angle)*p.x + cos(angle)*p.y;
  end rotate;

  function norm2
    input Real v[:];
    output Real n;
  algorithm
    n := sqrt(v*v);
  end norm2;

  model Resistor
    Pin p;
    Pin n;
    parameter Real R(unit = "Ohm") = 1;
  equation
    p.v - n.v = R*p.i;
    p.i + n.i = 0;
  end Resistor;

  model Capacitor
    Pin p;
    Pin n;
    parameter Real C(unit = "F") = 1;
    Real v(start = 0, fixed = true, unit = "V");
  equation
    v = p.v - n.v;
    C*der(v) = p.i;
    p.i + n.i = 0;
  end Capacitor;

  model Source
    Pin p;
    input Real v;
  equation
    p.v = v;
  end Source;

  model Ground
    Pin p;
  equation
    p.v = 0;
  end Ground;

  model RC
    Source source;
    Resistor r(R = 100);
    Capacitor c(C = 1e-3);
    Ground ground;
    input Real u;
    output Real y = c.v;
  equation
    source.v = u;
    connect(source.p, r.p);
    connect(r.n, c.p);
    connect(c.n, ground.p);
  end RC;

  model Ladder "Array of components, connected in a loop"
    parameter Integer n = 4;
    parameter Data data;
    Source source;
    Resistor r[n](each R = data.R);
    Capacitor c[n](each C = 2e-3);
    Ground ground;
    input Real u;
    output Real y = c[n].v;
  equation
    source.v = u;
    connect(source.p, r[1].p);
    for k in 1:n loop
      connect(r[k].n, c[k].p);
      connect(c[k].n, ground.p);
    end for;
    for k in 1:n - 1 loop
      connect(r[k].n, r[k + 1].p);
    end for;
  end Ladder;

  model Parallel "Two capacitors in parallel: index 2"
    Source source;
    Resistor r(R = 100);
    Capacitor c1(C = 1e-3);
    Capacitor c2(C = 3e-3);
    Ground ground;
    input Real u;
    output Real y = c2.v;
    output Real i2 = c2.p.i;
  equation
    source.v = u;
    connect(source.p, r.p);
    connect(r.n, c1.p);
    connect(r.n, c2.p);
    connect(c1.n, ground.p);
    connect(c2.n, ground.p);
  end Parallel;

  model Records
    input Real u;
    Point p;
    Point q;
    output Real y = q.y;
    output Real n = norm2({p.x, p.y, 2});
  equation
    p.x = u;
    p.y = 1;
    q = rotate(p, 1.5);
  end Records;

  model IfEquations
    parameter Boolean direct = true;
    parameter Integer order = 2;
    input Real u;
    Real x(start = 0, fixed = true);
    Real a, b;
    output Real y = a + b;
  equation
    if u > 0 then
      a = u;
      b = 2;
    elseif u > -1 then
      b = 1;
      a = 0;
    else
      a + b = u;
      a - b = 1;
    end if;
    if direct then
      der(x) = u;
    else
      der(x) = -u;
    end if;
  end IfEquations;

  model Matrices
    parameter Real A[2, 2] = [0, 1; -4, -0.4];
    parameter Real B[2, 1] = [0; 1];
    parameter Real C[1, 2] = [1, 0];
    Real x[2](start = {1, 0}, each fixed = true);
    input Real u;
    output Real y[1];
    Real t[2, 2] = transpose(A)*A + identity(2);
  equation
    der(x) = A*x + B*{u};
    y = C*x;
  end Matrices;

  connector RealInput = input Real;
  connector RealOutput = output Real;

  block Gain
    parameter Real k = 1;
    RealInput u;
    RealOutput y;
  equation
    y = k*u;
  end Gain;

  model Choice
    parameter Boolean useGain = true;
    Gain gain(k = 3) if useGain;
    RealInput u;
    RealOutput y;
  equation
    connect(gain.u, u);
    if useGain then
      connect(gain.y, y);
    else
      y = u;
    end if;
  end Choice;

  model Outer
    inner parameter Real g = 9.81;
    Falling a;
    Falling b(h(start = 2));
  end Outer;

  model Falling
    outer parameter Real g;
    Real h(start = 1, fixed = true);
    Real v(start = 0, fixed = true);
  equation
    der(h) = v;
    der(v) = -g;
  end Falling;
end Structure;
