model Tanks "A pump fills a tank that drains into a second one"
  connector Port
    Real h(unit = "m");
    flow Real q(unit = "m3/s");
  end Port;
  model Pump
    Port port;
    parameter Real k(unit = "m3/(s.V)", min = 0) = 4e-6 "Flow by voltage";
    input Real u(unit = "V");
  equation
    port.q = -k*u;
  end Pump;
  model Tank
    Port port;
    parameter Real A(unit = "m2", min = 0) = 2e-3 "Area";
    Real h(unit = "m", start = 0.1, fixed = true);
  equation
    h = port.h;
    A*der(h) = port.q;
  end Tank;
  model Hole "Free outflow through a hole in the bottom"
    Port a, b;
    parameter Real S(unit = "m2", min = 0) = 1e-5 "Area of the jet";
  equation
    a.q = S*sqrt(2*9.81*max(a.h, 1e-6));
    b.q = -a.q;
  end Hole;
  model Drain
    Port port;
  equation
    port.h = 0;
  end Drain;
  input Real u(unit = "V") "Voltage of the pump";
  output Real h_upper(unit = "m");
  output Real h_lower(unit = "m");
  Pump pump;
  Tank upper;
  Hole between;
  Tank lower;
  Hole outlet;
  Drain drain;
equation
  pump.u = u;
  connect(pump.port, upper.port);
  connect(upper.port, between.a);
  connect(between.b, lower.port);
  connect(lower.port, outlet.a);
  connect(outlet.b, drain.port);
  h_upper = upper.h;
  h_lower = lower.h;
end Tanks;
