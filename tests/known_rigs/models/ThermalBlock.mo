model ThermalBlock "A heated block in a casing, over hours"
  connector Port
    Real T(unit="K");
    flow Real Q(unit="W");
  end Port;
  model Store
    Port port;
    parameter Real C(unit="J/K", min=0) = 1000 "Heat capacity";
    Real T(unit="K", start=293.15, fixed=true);
  equation
    T = port.T;
    C*der(T) = port.Q;
  end Store;
  model Wall
    Port a, b;
    parameter Real G(unit="W/K", min=0) = 1 "Conductance";
  equation
    a.Q = G*(a.T - b.T);
    b.Q = -a.Q;
  end Wall;
  model Heater
    Port port;
    input Real P(unit="W");
  equation
    port.Q = -P;
  end Heater;
  model Surroundings
    Port port;
    parameter Real T(unit="K") = 293.15;
  equation
    port.T = T;
  end Surroundings;
  input Real P(unit="W") "Heating power";
  output Real T_body(unit="K") "Thermocouple in the body";
  output Real T_casing(unit="K") "Thermocouple on the casing";
  Heater heater; Store body(C=1500); Wall wall(G=1.2); Store casing(C=2500); Wall air(G=0.8); Surroundings room;
equation
  heater.P = P;
  connect(heater.port, body.port);
  connect(body.port, wall.a);
  connect(wall.b, casing.port);
  connect(casing.port, air.a);
  connect(air.b, room.port);
  T_body = body.T;
  T_casing = casing.T;
end ThermalBlock;
