model Oven "An electric oven: an element heats a chamber, the chamber loses heat to the room"
  connector Port
    Real T(unit = "K");
    flow Real Q(unit = "W");
  end Port;
  model Mass
    Port port;
    parameter Real C(unit = "J/K", min = 0) = 100 "Heat capacity";
    Real T(unit = "K", start = 293, fixed = true);
  equation
    T = port.T;
    C*der(T) = port.Q;
  end Mass;
  model Wall
    Port a, b;
    parameter Real G(unit = "W/K", min = 0) = 1 "Conductance";
  equation
    a.Q = G*(a.T - b.T);
    b.Q = -a.Q;
  end Wall;
  model Heater
    Port port;
    input Real P(unit = "W");
  equation
    port.Q = -P;
  end Heater;
  model Room
    Port port;
  equation
    port.T = 293;
  end Room;
  input Real P(unit = "W") "Power";
  output Real T_element(unit = "K");
  output Real T_chamber(unit = "K");
  Heater heater;
  Mass element(C = 60);
  Wall contact(G = 0.8);
  Mass chamber(C = 500);
  Wall insulation(G = 0.5);
  Room room;
equation
  heater.P = P;
  connect(heater.port, element.port);
  connect(element.port, contact.a);
  connect(contact.b, chamber.port);
  connect(chamber.port, insulation.a);
  connect(insulation.b, room.port);
  T_element = element.T;
  T_chamber = chamber.T;
end Oven;
