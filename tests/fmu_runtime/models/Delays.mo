package Delays
  model Past "Delays of an expression, a state in a loop, and of what is delayed itself"
    parameter Real T = 0.7;
    parameter Real k = 1;
    Real x(start = 1, fixed = true);
    output Real y = delay(sin(3*time), 0.5);
    output Real w = delay(x, T);
    output Real twice = delay(y, 0.5);
    output Real now = delay(x, 0);
  equation
    der(x) = -k*w;
    annotation(experiment(StopTime = 3));
  end Past;

  model Jumps "A jump at a state event comes back as a jump"
    parameter Real T = 0.31;
    parameter Real h = 1;
    input Real u;
    Real x(start = 0, fixed = true);
    output Real y = delay(if x > 0.4 then h else 0, T);
    output Real z = delay(y, 2*T);
    output Real v = delay(u, T);
  equation
    der(x) = y + 1 - x;
    annotation(experiment(StopTime = 2));
  end Jumps;

  model Backwards "The delay must be positive"
    parameter Real T = 0;
    output Real y = delay(time, T);
  end Backwards;
end Delays;
