model Tanks "A pump fills a tank that drains into another"
  connector Opening
    Real h(unit="m") "Level";
    flow Real q(unit="m3/s");
  end Opening;
  model Pump
    Opening port;
    parameter Real k(unit="m3/(s.V)", min=0) = 3e-6 "Flow by voltage";
    input Real u(unit="V");
  equation
    port.q = -k*u;
  end Pump;
  model Tank
    Opening port;
    parameter Real A(unit="m2", min=0) = 2e-3 "Section";
    Real h(unit="m", start=0.05, fixed=true, min=0);
  equation
    h = port.h;
    A*der(h) = port.q;
  end Tank;
  model Orifice "Free outflow at the bottom of a tank"
    Opening a, b;
    parameter Real S(unit="m2", min=0) = 8e-6 "Section of the jet";
  equation
    a.q = S*sqrt(2*9.81*max(a.h, 1e-6));
    b.q = -a.q;
  end Orifice;
  model Basin
    Opening port;
  equation
    port.h = 0;
  end Basin;
  input Real u(unit="V") "Voltage of the pump";
  output Real h_upper(unit="m") "Level of the upper tank";
  output Real h_lower(unit="m") "Level of the lower tank";
  Pump pump; Tank upper; Orifice first; Tank lower; Orifice second; Basin basin;
equation
  pump.u = u;
  connect(pump.port, upper.port);
  connect(upper.port, first.a);
  connect(first.b, lower.port);
  connect(lower.port, second.a);
  connect(second.b, basin.port);
  h_upper = upper.h;
  h_lower = lower.h;
end Tanks;
