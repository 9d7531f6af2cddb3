model Cooler "A heated block that loses heat to the room"
  connector Port
    Real T(unit = "K");
    flow Real Q(unit = "W");
  end Port;
  model Heater
    Port port;
    input Real P(unit = "W");
  equation
    port.Q = -P;
  end Heater;
  model Block
    Port port;
    parameter Real C(unit = "J/K", min = 0) = 200 "Heat capacity";
    Real T(unit = "K", start = 293, fixed = true);
  equation
    T = port.T;
    C*der(T) = port.Q;
  end Block;
  model Air
    Port port;
    parameter Real G(unit = "W/K", min = 0) = 1 "Conductance to the room";
  equation
    port.Q = G*(port.T - 293);
  end Air;
  input Real P(unit = "W") "Power";
  output Real T(unit = "K") "Temperature of the block";
  Heater heater;
  Block body;
  Air air;
equation
  heater.P = P;
  connect(heater.port, body.port);
  connect(body.port, air.port);
  T = body.T;
end Cooler;
