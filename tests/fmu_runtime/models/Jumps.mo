package Jumps "Models whose runs jump or bend at events, for the derivatives of whole runs"
  model Ball "Bounces"
    parameter Real e = 0.8;
    parameter Real g = 9.81;
    parameter Real h0 = 1;
    output Real h(start = h0, fixed = true);
    output Real v(start = 0, fixed = true);
  equation
    der(h) = v;
    der(v) = -g;
    when h < 0 then
      reinit(v, -e*pre(v));
    end when;
  end Ball;

  model Sampled "PI controller that samples"
    parameter Real kp = 2;
    parameter Real ki = 3;
    parameter Real a = 1.5;
    parameter Real r = 1;
    output Real x(start = 0.1, fixed = true);
    output Real u(start = 0);
    discrete Real i(start = 0);
    discrete Real xs(start = 0);
  equation
    der(x) = -a*x + u;
    when sample(0.05, 0.1) then
      xs = x;
      i = pre(i) + 0.1*(r - xs);
      u = kp*(r - xs) + ki*i;
    end when;
  end Sampled;

  model SampledLater "Sample times that depend on parameters"
    parameter Real T0 = 0.05;
    parameter Real T = 0.13;
    parameter Real k = 2;
    output Real x(start = 0.1, fixed = true);
    output Real u(start = 0);
  equation
    der(x) = -x + u + sin(5*time);
    when sample(T0, T) then
      u = k*(1 - x) + 0.3*pre(u);
    end when;
  end SampledLater;

  model Level "A reinit at a level that a parameter gives"
    parameter Real level = 0.7;
    parameter Real back = 0.2;
    parameter Real a = 1.3;
    output Real x(start = 0, fixed = true);
    output Real w(start = 1, fixed = true);
  equation
    der(x) = a*(1 + 0.3*w);
    der(w) = -w + x;
    when x > level + 0.1*w then
      reinit(x, back*w);
      reinit(w, 0.9*w + 0.1*a);
    end when;
  end Level;

  model Thermostat "Boolean hysteresis"
    parameter Real low = 18;
    parameter Real high = 22;
    parameter Real tau = 2;
    parameter Real power = 12;
    parameter Real T0 = 15;
    output Real T(start = T0, fixed = true);
    Boolean on(start = true, fixed = true);
    output Real heat;
  equation
    on = T < low or pre(on) and T < high;
    heat = if on then power else 0;
    tau*der(T) = -(T - 15) + heat;
  end Thermostat;

  model Switch "A time event at a time that is a parameter"
    parameter Real t1 = 0.37;
    parameter Real a = 2;
    parameter Real b = -3;
    output Real x(start = 1, fixed = true);
    output Real y = x^2;
  equation
    der(x) = if time > t1 then b*x else a;
  end Switch;

  model Loop "An algebraic loop whose form an event changes"
    parameter Real a = 1;
    parameter Real level = 0.8;
    parameter Real c = 2;
    output Real x(start = 2, fixed = true);
    output Real y(start = 0.5);
    Boolean below(start = false, fixed = true);
    discrete Real held(start = 0);
  equation
    y^3 + a*y + 0.1*held*y = x + (if pre(below) then c*time else 0);
    der(x) = -y - 0.2*held;
    below = y < level or pre(below);
    when y < level then
      held = x*a;
    end when;
  end Loop;

  model Timer "A delay that starts at a state event"
    parameter Real level = 0.5;
    parameter Real delay = 0.3;
    parameter Real a = 1.1;
    output Real x(start = 0, fixed = true);
    discrete output Real due(start = 1e9);
    output Real w(start = 0, fixed = true);
  equation
    der(x) = a*cos(x);
    when x > level then
      due = time + delay*a;
    end when;
    der(w) = if time > due then x else 0;
  end Timer;

  model Chain "Events that set off others at the same time"
    parameter Real level = 0.5;
    parameter Real k = 1.7;
    output Real x(start = 0, fixed = true);
    output Real w(start = 1, fixed = true);
    discrete output Real a(start = 1);
    discrete output Real b(start = 2);
    Integer n(start = 0, fixed = true);
  equation
    der(x) = k*a;
    der(w) = -b*w + x;
    when x > level then
      n = pre(n) + 1;
      reinit(x, -0.2*x*w);
    end when;
    when change(n) then
      a = pre(a)*0.8 + 0.1*w;
    end when;
    when a < pre(a) then
      b = pre(b) + a*k;
      reinit(w, w + a);
    end when;
  end Chain;

  model Slip "Coulomb friction with modes, dragged by a spring"
    parameter Real m = 1;
    parameter Real F_c = 1;
    parameter Real F_max = 1.5;
    parameter Real c = 100;
    parameter Real v0 = 0.1;
    output Real s(start = 0, fixed = true);
    output Real v(start = 0, fixed = true, stateSelect = StateSelect.always);
    Real a;
    Real f;
    Real sa;
    output Real F;
    Boolean startForward(start = false, fixed = true);
    Boolean startBackward(start = false, fixed = true);
    Boolean locked(start = false);
    Integer mode(start = 3, fixed = true);
  equation
    F = c*(v0*time - s);
    v = der(s);
    a = der(v);
    m*a = F - f;
    startForward = pre(mode) == 0 and (sa > F_max or pre(startForward) and sa > F_c)
      or pre(mode) == -1 and v > 1e-10 or initial() and v > 0;
    startBackward = pre(mode) == 0 and (sa < -F_max or pre(startBackward) and sa < -F_c)
      or pre(mode) == 1 and v < -1e-10 or initial() and v < 0;
    locked = not (pre(mode) == 1 or pre(mode) == -1 or startForward or startBackward);
    a = if locked then 0 else if startForward then sa - F_c
      else if startBackward then sa + F_c
      else if pre(mode) == 1 then sa - F_c else sa + F_c;
    f = if locked then sa else if startForward then F_c
      else if startBackward then -F_c
      else if pre(mode) == 1 then F_c else -F_c;
    mode = if (pre(mode) == 1 or startForward) and v > 0 then 1
      else if (pre(mode) == -1 or startBackward) and v < 0 then -1 else 0;
  end Slip;

  model Ceiling "Thrown up to a ceiling that is hardly reached"
    parameter Real v0 = 4;
    parameter Real H = 0.8;
    output Real h(start = 0, fixed = true);
    output Real v(start = v0, fixed = true);
  equation
    der(h) = v;
    der(v) = -10;
    when h > H then
      reinit(v, -0.5*v);
    end when;
  end Ceiling;

  model Initial "What the initial event iteration computes"
    parameter Real a = 0.4;
    parameter Real b = 1.3;
    output Real x(start = 2*a, fixed = true);
    discrete output Real z(start = b, fixed = true);
    discrete output Real k(start = 0);
  initial equation
    pre(k) = 3*a*b;
  equation
    when {initial(), x < 0.3} then
      z = pre(z) + x*b;
    end when;
    when x < 0.5 then
      k = pre(k) + z*x;
    end when;
    der(x) = -b*x + 0.05*z + 0.01*k;
  end Initial;

  model Crossing "Two events whose times depend on different parameters"
    parameter Real T = 0.5;
    parameter Real level = 0.5;
    output Real x(start = 0, fixed = true);
    output Real w(start = 1, fixed = true);
    output Real s(start = 0, fixed = true);
  equation
    der(x) = 1;
    der(w) = if time > T then -w else 0;
    der(s) = w;
    when x > level then
      reinit(w, 2*w);
    end when;
  end Crossing;
end Jumps;
