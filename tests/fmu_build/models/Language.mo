package Language "What of Modelica is translated"
  type Mode = enumeration(Stuck "at rest", Forward, Backward);

  record Data
    Real a;
    Real b;
  end Data;

  function interpolate "Linear interpolation, clamped outside the rows"
    input Real table[:, :];
    input Real u;
    input Integer column = 2;
    output Real y;
  protected
    Integer n = size(table, 1);
    Real s;
  algorithm
    y := table[1, column];
    for i in 1:n - 1 loop
      s := max(0, min(1, (u - table[i, 1])/(table[i + 1, 1] - table[i, 1])));
      y := y + s*(table[i + 1, column] - table[i, column]);
    end for;
  end interpolate;

  function search "The row in force, found by a loop with if and a symbolic index"
    input Real table[:, :];
    input Real u;
    output Real y;
  protected
    Integer k;
  algorithm
    k := 1;
    for i in 1:size(table, 1) loop
      if u > table[i, 1] then
        k := i;
      end if;
    end for;
    y := table[k, 2];
  end search;

  function split
    input Real u[:];
    output Real total;
    output Real largest;
  protected
    Real squares[size(u, 1)];
  algorithm
    total := 0;
    largest := u[1];
    for i in 1:size(u, 1) loop
      squares[i] := u[i]^2;
      total := total + squares[i];
      if u[i] > largest then
        largest := u[i];
      elseif u[i] < -100 then
        largest := 0;
      else
        largest := largest;
      end if;
    end for;
  end split;

  function endless
    input Real u;
    output Real y;
  algorithm
    y := u;
    while y > 1 loop
      y := y/2;
    end while;
  end endless;

  model Parameters "Parameters that depend on parameters, arrays, structure"
    constant Real c = 2.5;
    parameter Integer n = 3;
    parameter Real a(min = 0, max = 10, unit = "m") = 2 "A length";
    parameter Real b = 2*a + c;
    final parameter Real fixedValue = 7;
    parameter Real copy = a;
    parameter Boolean swap = false;
    parameter Mode mode = Mode.Forward;
    parameter Real table[n, 2] = [0, 1; 1, 3; 2, 4];
    parameter Real vector[n] = {1, a, 3};
    parameter Real unbound(start = 4);
    parameter Real later(fixed = false);
    parameter String name = "text";
    Real x[n](each start = 1, each fixed = true);
    output Real s = if swap then -sum(x) else sum(x);
    output Real q = if mode == Mode.Forward then b + fixedValue else later;
    output Real product = vector*vector;
  initial equation
    later = 3*b;
  equation
    for i in 1:n loop
      der(x[i]) = -table[i, 2]*x[i] + (if i > 1 then x[max(i - 1, 1)] else 0);
    end for;
  end Parameters;

  model Functions
    parameter Real table[3, 2] = [0, 1; 1, 3; 2, 4];
    input Real u(start = 0.5);
    output Real y = interpolate(table, u);
    output Real z = search(table, u);
    output Real total;
    output Real largest;
  equation
    (total, largest) = split({u, 2*u, -u});
  end Functions;

  model Arithmetic "Built-in functions without events"
    input Real u;
    output Real y[16];
  equation
    y[1] = noEvent(if u > 0 then sqrt(u) else 0);
    y[2] = abs(u)*sign(u);
    y[3] = noEvent(max(u, 2) + min(u, 1, -1));
    y[4] = atan2(u, 2) + sinh(u/10) + log10(abs(u) + 1);
    y[5] = noEvent(mod(u, 3));
    y[6] = noEvent(rem(u, 3)) + noEvent(div(u, 2));
    y[7] = noEvent(floor(u)) + noEvent(ceil(u));
    y[8] = smooth(1, if u > 0 then u^2 else -u^2);
    y[9] = exp(-u^2) + tanh(u) + cos(u)^3;
    y[10] = sum({u, 2, 3}) + product({2, u}) + {1, 2}*{u, u};
    y[11:12] = [1, 2; 3, 4]*{u, 1};
    y[13] = homotopy(u, 0) + size(y, 1);
    y[14] = sum(i*u for i in 1:3) + max({u, 4});
    y[15] = noEvent(if u > 1 or u < -1 and not u < -2 then 1 else 2);
    y[16] = noEvent(if u > 0 then log(u) elseif u < -1 then log(-u) else 0);
  end Arithmetic;

  model LinearLoop "Two equations that need each other"
    input Real u;
    parameter Real a = 2;
    parameter Real b = 3;
    Real x, y, z;
  equation
    a*x + b*y + z = u;
    b*x - a*y + z = 1;
    x + y - a*z = time;
  end LinearLoop;

  model NonlinearLoop "Kepler's equation with a rate: E - e sin E = M"
    parameter Real e = 0.6;
    Real m(start = 0.3, fixed = true);
    output Real angle(start = 1);
    output Real x = cos(angle) - e;
  equation
    der(m) = 1 + 0.1*angle;
    angle - e*sin(angle) = m;
  end NonlinearLoop;

  model SteadyStart "Initial equations that need Newton's method"
    parameter Real u = 2;
    Real x(start = 1);
    Real w(start = 0.5, fixed = true);
  initial equation
    der(x) = 0;
  equation
    der(x) = u - x^3 + w;
    der(w) = -w;
  end SteadyStart;

  partial model Base
    replaceable model Law = Linear;
    Law law;
    parameter Boolean extra = false;
    Real loss = 2*law.y if extra;
  end Base;

  model Linear
    parameter Real k = 1;
    input Real u;
    output Real y;
  equation
    y = k*u;
  end Linear;

  model Square
    extends Linear;
    output Real y2;
  equation
    y2 = y^2;
  end Square;

  model Cubed = Square(k = 3);

  model Redeclared
    extends Base(redeclare model Law = Cubed, extra = true);
    input Real u;
    output Real y = law.y2;
  equation
    law.u = u;
  end Redeclared;

  model Checked
    input Real u;
    output Real y = u;
  equation
    assert(u < 5, "u is " + String(u) + ", too much");
    assert(u > -5, "rather low", AssertionLevel.warning);
  end Checked;

  model WhileLoop
    input Real u;
    output Real y = endless(u);
  end WhileLoop;

  model InputDerivative
    input Real u;
    output Real y;
  equation
    y = der(u);
  end InputDerivative;

  model Singular
    Real x, y;
  equation
    x + y = 1;
    2*x + 2*y = time;
  end Singular;

  model Contradiction
    Real x(start = 1, fixed = true);
    Real y(start = 3, fixed = true);
  equation
    der(x) = -x;
    y = 2*x;
  end Contradiction;

  model Circle
    parameter Real a = b;
    parameter Real b = a;
    Real x = a;
  end Circle;

  model WithAlgorithm
    Real x;
  algorithm
    if noEvent(time > 1) then
      x := 2*time;
    else
      x := 3;
    end if;
  end WithAlgorithm;

  model Sized
    parameter Integer k = 2;
    parameter Integer m = k + 1;
    output Real y = sum(fill(2.0, m));
  end Sized;
end Language;
