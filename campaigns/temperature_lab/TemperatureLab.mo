model TemperatureLab "A circuit board with two heaters, each with a sensor glued to it; one heater is on"
  connector Port
    Real T(unit = "K");
    flow Real Q(unit = "W");
  end Port;
  model Mass
    Port port;
    parameter Real C(unit = "J/K", min = 0) = 1 "Heat capacity";
    parameter Real T_start(unit = "K") = 295 "Temperature at the start";
    Real T(unit = "K", start = T_start, fixed = true);
  equation
    T = port.T;
    C*der(T) = port.Q;
  end Mass;
  model Wall
    Port a, b;
    parameter Real G(unit = "W/K", min = 0) = 0.02 "Conductance";
  equation
    a.Q = G*(a.T - b.T);
    b.Q = -a.Q;
  end Wall;
  model Heater
    Port port;
    input Real share(unit = "%");
    parameter Real P_max(unit = "W") = 2.1 "Power at 100 %";
  equation
    port.Q = -0.01*share*P_max;
  end Heater;
  model Room
    Port port;
    parameter Real T(unit = "K") = 295;
  equation
    port.T = T;
  end Room;
  input Real Q1(unit = "%") "Setting of the first heater";
  output Real T1(unit = "K") "First sensor";
  output Real T2(unit = "K") "Second sensor";
  parameter Real T_room(unit = "K") = 295;
  parameter Real T1_start(unit = "K") = 295;
  parameter Real T2_start(unit = "K") = 295;
  parameter Real C_heater(unit = "J/K", min = 0) = 8;
  parameter Real C_sensor(unit = "J/K", min = 0) = 1;
  parameter Real G_sensor(unit = "W/K", min = 0) = 0.05;
  parameter Real G_loss(unit = "W/K", min = 0) = 0.03;
  parameter Real G_between(unit = "W/K", min = 0) = 0.02;
  Heater heater;
  Mass heater1(C = C_heater, T_start = T1_start);
  Mass heater2(C = C_heater, T_start = T2_start);
  Mass sensor1(C = C_sensor, T_start = T1_start);
  Mass sensor2(C = C_sensor, T_start = T2_start);
  Wall glue1(G = G_sensor);
  Wall glue2(G = G_sensor);
  Wall between(G = G_between);
  Wall loss1(G = G_loss);
  Wall loss2(G = G_loss);
  Room room(T = T_room);
equation
  heater.share = Q1;
  connect(heater.port, heater1.port);
  connect(heater1.port, glue1.a);
  connect(glue1.b, sensor1.port);
  connect(heater2.port, glue2.a);
  connect(glue2.b, sensor2.port);
  connect(heater1.port, between.a);
  connect(between.b, heater2.port);
  connect(heater1.port, loss1.a);
  connect(loss1.b, room.port);
  connect(heater2.port, loss2.a);
  connect(loss2.b, room.port);
  T1 = sensor1.T;
  T2 = sensor2.T;
end TemperatureLab;
