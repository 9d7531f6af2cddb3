package Hybrid "Events"
  model BouncingBall
    parameter Real e = 0.8;
    parameter Real h0 = 1;
    Real h(start = h0, fixed = true);
    Real v(start = 0, fixed = true);
    Integer bounces(start = 0, fixed = true);
    Boolean flying(start = true, fixed = true);
    Boolean impact;
    Real v_new(start = 0);
  equation
    impact = h <= 0;
    der(h) = v;
    der(v) = if flying then -9.81 else 0;
    when {h <= 0 and v <= 0, impact} then
      v_new = if edge(impact) then -e*pre(v) else 0;
      flying = v_new > 0;
      bounces = pre(bounces) + 1;
      reinit(v, v_new);
    end when;
  end BouncingBall;

  model Sampled "Discrete controller"
    parameter Real T = 0.1;
    Real x(start = 0, fixed = true);
    discrete Real u(start = 0);
    discrete Real xs(start = 0);
    Integer k(start = 0);
    Boolean late;
  equation
    der(x) = u - x;
    when sample(0.05, T) then
      xs = x;
      u = pre(u) + 0.5*(1 - xs);
      k = pre(k) + 1;
    end when;
    late = time > 0.72;
  end Sampled;

  model Relay "Hysteresis: state events, pre, edge, change"
    Real x(start = 0, fixed = true);
    Boolean on(start = true, fixed = true);
    Integer switches(start = 0, fixed = true);
    Integer edges(start = 0, fixed = true);
  equation
    der(x) = if on then 1 - x else -x;
    on = x < 0.2 or pre(on) and x < 0.8;
    when change(on) then
      switches = pre(switches) + 1;
    end when;
    when edge(on) then
      edges = pre(edges) + 1;
    end when;
  end Relay;

  model Steps "Event-generating functions"
    output Real y = floor(3*time);
    output Real saw = mod(time, 0.5);
    output Real s = if time > 0.25 then 1 else 0;
    Real x(start = 0, fixed = true);
  equation
    der(x) = y;
  end Steps;

  type Mode = enumeration(Free, Stuck, Forward, Backward);

  model Coulomb "One mass under a sine force with Coulomb friction in the manner of BearingFriction"
    parameter Real m = 1;
    parameter Real F_c = 1 "Sliding friction";
    parameter Real F_max = 1.5 "Break-away";
    input Real F;
    Real s(start = 0, fixed = true);
    Real v(start = 0, fixed = true, stateSelect = StateSelect.always);
    Real a;
    Real f;
    Real sa "Path parameter of the friction characteristic";
    Boolean startForward(start = false, fixed = true);
    Boolean startBackward(start = false, fixed = true);
    Boolean locked(start = false);
    Integer mode(start = 3, fixed = true) "-1 backward, 0 stuck, 1 forward, 2 free, 3 unknown";
    Real lossEnergy(start = 0, fixed = true);
  equation
    v = der(s);
    a = der(v);
    m*a = F - f;
    der(lossEnergy) = f*v;
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
  end Coulomb;

  model Ends
    Real x(start = 0, fixed = true);
  equation
    der(x) = 1;
    when x > 0.5 then
      terminate("enough");
    end when;
  end Ends;

  model BooleanInput
    input Boolean b;
    Integer n(start = 0, fixed = true);
    Real x(start = 0, fixed = true);
  equation
    when b then
      n = pre(n) + 1;
    end when;
    der(x) = if b then 1 else 0;
  end BooleanInput;

  model Lossy "Two inertias and a gear with mesh and bearing friction, modes in the manner of LossyGear"
    parameter Real J_a = 0.01;
    parameter Real J_b = 1;
    parameter Real ratio = 5;
    parameter Real eta1 = 0.8;
    parameter Real eta2 = 0.7;
    parameter Real tau_bf = 0.1;
    input Real u "Torque on side a";
    input Real load "Torque on side b";
    Real phi_a, w_a, a_a, phi_b, w_b;
    Real tau_a, tau_b;
    Real sa, loss, lossMax, lossMin;
    Real phi(start = 0, fixed = true, stateSelect = StateSelect.always) = phi_b;
    Real w(start = 0, fixed = true, stateSelect = StateSelect.always) = w_b;
    Real lossEnergy(start = 0, fixed = true);
    Boolean tau_pos(start = true);
    Boolean startForward(start = false);
    Boolean startBackward(start = false);
    Boolean locked(start = false);
    Integer mode(start = 2, fixed = true) "-1 backward, 0 stuck, 1 forward, 2 free";
  equation
    J_a*a_a = u - tau_a;
    J_b*der(w_b) = tau_b + load;
    w_b = der(phi_b);
    phi_a = ratio*phi_b;
    w_a = der(phi_a);
    a_a = der(w_a);
    tau_b = ratio*(tau_a - loss);
    der(lossEnergy) = loss*w_a;
    tau_pos = tau_a >= 0;
    lossMax = if tau_pos then (1 - eta1)*tau_a + tau_bf else (1 - 1/eta2)*tau_a + tau_bf;
    lossMin = if tau_pos then (1 - 1/eta2)*tau_a - tau_bf else (1 - eta1)*tau_a - tau_bf;
    startForward = pre(mode) == 0 and sa > lossMax or initial() and w_a > 0;
    startBackward = pre(mode) == 0 and sa < lossMin or initial() and w_a < 0;
    locked = not (pre(mode) == 1 or startForward or pre(mode) == -1 or startBackward);
    loss = if locked then sa else if startForward or pre(mode) == 1 then lossMax else lossMin;
    a_a = if locked then 0 else sa - loss;
    mode = if (pre(mode) == 1 or startForward) and w_a > 0 then 1
      else if (pre(mode) == -1 or startBackward) and w_a < 0 then -1 else 0;
  end Lossy;

  model Pulse "Initial algorithm, and discrete variables that start from the state"
    parameter Real period = 0.3;
    parameter Real offset = -1;
    output Real y;
    Real begin;
    Integer count;
    discrete Real z;
    Real x(start = 2, fixed = true);
  initial algorithm
    count := integer((time - offset)/period);
    begin := offset + count*period;
  initial equation
    z = 2*x;
  equation
    when integer((time - offset)/period) > pre(count) then
      count = pre(count) + 1;
      begin = time;
    end when;
    when time > 0.5 then
      z = x;
    end when;
    y = if time < begin + period/2 then 1 else 0;
    der(x) = -z;
  end Pulse;

  model AtStart "initial() in when-clauses"
    parameter Real x0 = 2;
    Real x(start = x0, fixed = true);
    Integer a(start = 0), b(start = 0), c(start = 0);
  equation
    der(x) = 1;
    when {initial(), time > 0.5} then
      a = pre(a) + 1;
    end when;
    when initial() and x > 1 then
      b = pre(b) + 1;
    end when;
    when x > 1 then
      c = pre(c) + 1;
    end when;
  end AtStart;

  model SampledFromStart "The first instant is the start itself"
    Integer n(start = 0, fixed = true);
    Integer k(start = 0, fixed = true);
  equation
    when sample(0, 0.25) then
      n = pre(n) + 1;
    end when;
    when {initial(), sample(0.5, 0.25)} then
      k = pre(k) + 1;
    end when;
  end SampledFromStart;

  model DeadBeat "A sampled control that is the derivative itself"
    Real x(start = 1, fixed = true);
    discrete Real u(start = 0, fixed = true);
  equation
    der(x) = u;
    when sample(0, 0.1) then
      u = -x/0.1;
    end when;
  end DeadBeat;

  model Quiet
    output Real y = noEvent(if time > 1 then 1 else 0);
    output Real q = smooth(0, if time > 1 then time else 1);
  end Quiet;
end Hybrid;
