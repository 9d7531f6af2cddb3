model HeatExchanger "Hot water warms cold water through a wall"
  connector Port
    Real T(unit="K");
    flow Real Q(unit="W");
  end Port;
  model Side "Water on one side of the wall, well mixed"
    Port port;
    parameter Real C(unit="J/K", min=0) = 2e5 "Heat capacity";
    Real T(unit="K", start=288.15, fixed=true);
  equation
    T = port.T;
    C*der(T) = port.Q;
  end Side;
  model Film "Between water and metal"
    Port a, b;
    parameter Real G(unit="W/K", min=0) = 1000 "Conductance";
  equation
    a.Q = G*(a.T - b.T);
    b.Q = -a.Q;
  end Film;
  model Stream "Brings water of one temperature and takes away what is there"
    Port port;
    constant Real cp(unit="J/(kg.K)") = 4180;
    input Real flow_rate(unit="kg/s"), T(unit="K");
  equation
    port.Q = flow_rate*cp*(port.T - T);
  end Stream;
  model Mains "Cold water at a constant rate"
    Port port;
    constant Real cp(unit="J/(kg.K)") = 4180;
    parameter Real flow_rate(unit="kg/s", min=0) = 0.3;
  equation
    port.Q = flow_rate*cp*(port.T - 288.15);
  end Mains;
  model Bleed "Opens when it is hot"
    Port port;
    parameter Real K(unit="W/K", min=0) = 600;
  equation
    port.Q = K*max(port.T - 345, 0);
  end Bleed;
  input Real m_hot(unit="kg/s") "Flow of the hot water";
  input Real T_in(unit="K") "Temperature of the hot water";
  output Real T_hot(unit="K") "Hot side";
  output Real T_cold(unit="K") "Cold side";
  Stream supply; Side hot(C=3e5); Film film(G=1500); Side wall(C=8e4); Film skin(G=1200); Side cold(C=2.5e5);
  Mains mains; Bleed bleed;
equation
  supply.flow_rate = m_hot;
  supply.T = T_in;
  connect(supply.port, hot.port);
  connect(hot.port, film.a);
  connect(film.b, wall.port);
  connect(wall.port, skin.a);
  connect(skin.b, cold.port);
  connect(cold.port, mains.port);
  connect(hot.port, bleed.port);
  T_hot = hot.T;
  T_cold = cold.T;
end HeatExchanger;
