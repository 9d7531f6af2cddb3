package Transports
  model Once "What enters leaves one length later; the contents have a bend and a jump at the start"
    parameter Real v = 2;
    parameter Real h = 4;
    Real x(start = 0.3, fixed = true);
    output Real a;
    output Real b;
  equation
    der(x) = v;
    (a, b) = spatialDistribution(sin(3*time), 7, x, v >= 0, {0, 0.25, 0.25, 1}, {1, 2, h, 3});
    annotation(experiment(StopTime = 2));
  end Once;

  model ThereAndBack "The flow turns, and what has not left comes back"
    parameter Real v = 1.5;
    parameter Real k = 1;
    Real x(start = 0, fixed = true);
    Real y(start = 0, fixed = true);
    output Real a;
    output Real b;
  equation
    der(x) = v*cos(time);
    (a, b) = spatialDistribution(in0 = k*time, in1 = -k*time, x = x, positiveVelocity = der(x) >= 0);
    der(y) = b - y;
    annotation(experiment(StopTime = 8));
  end ThereAndBack;

  model Ring "A ring whose contents drive it"
    parameter Real c = 0.5;
    parameter Real top = 2;
    Real x(start = 0, fixed = true);
    Real v(start = 1, fixed = true);
    output Real a;
    output Real b;
  equation
    der(x) = v;
    der(v) = b - c*v;
    (a, b) = spatialDistribution(b, a, x, v >= 0, initialPoints = {0, 0.5, 1}, initialValues = {1, top, 1});
    annotation(experiment(StopTime = 5));
  end Ring;
end Transports;
