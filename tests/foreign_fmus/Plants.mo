package Plants "The plants of plants.c in Modelica"
  model Drive "Two inertias on a shaft"
    parameter Real J1(unit = "kg.m2") = 2e-3;
    parameter Real c(unit = "N.m/rad") = 15;
    parameter Real d(unit = "N.m.s/rad") = 0.02;
    parameter Real J2(unit = "kg.m2") = 5e-3;
    input Real tau(unit = "N.m");
    output Real w1(unit = "rad/s", start = 0, fixed = true);
    output Real w2(unit = "rad/s", start = 0, fixed = true);
    Real phi1(unit = "rad", start = 0, fixed = true);
    Real phi2(unit = "rad", start = 0, fixed = true);
    Real shaft(unit = "N.m");
  equation
    der(phi1) = w1;
    der(phi2) = w2;
    shaft = c*(phi1 - phi2) + d*(w1 - w2);
    J1*der(w1) = tau - shaft;
    J2*der(w2) = shaft;
  end Drive;

  model House "A room and a wall"
    parameter Real C_room(unit = "J/K") = 2e5;
    parameter Real G_wall(unit = "W/K") = 80;
    parameter Real C_wall(unit = "J/K") = 3e6;
    parameter Real G_out(unit = "W/K") = 40;
    input Real P_heat(unit = "W");
    input Real T_out(unit = "K", start = 283);
    output Real T_room(unit = "K", start = 293, fixed = true);
    output Real T_wall(unit = "K", start = 290, fixed = true);
    Real inside(unit = "W");
  equation
    inside = G_wall*(T_room - T_wall);
    C_room*der(T_room) = P_heat - inside;
    C_wall*der(T_wall) = inside - G_out*(T_wall - T_out);
  end House;

  model Circuit "A coil, and a capacitor with a load"
    parameter Real L(unit = "H") = 1e-2;
    parameter Real R(unit = "Ohm") = 2;
    parameter Real C(unit = "F") = 1e-3;
    parameter Real R_load(unit = "Ohm") = 20;
    input Real v_in(unit = "V");
    output Real i(unit = "A", start = 0, fixed = true);
    output Real v(unit = "V", start = 0, fixed = true);
  equation
    L*der(i) = v_in - R*i - v;
    C*der(v) = i - v/R_load;
  end Circuit;

  model Tank "Two tanks, one after the other"
    parameter Real A1(unit = "m2") = 0.02;
    parameter Real A2(unit = "m2") = 0.015;
    parameter Real k1(unit = "m2.5/s") = 1.2e-3;
    parameter Real k2(unit = "m2.5/s") = 1e-3;
    input Real q(unit = "m3/s");
    output Real h1(unit = "m", start = 0.3, fixed = true);
    output Real h2(unit = "m", start = 0.25, fixed = true);
    Real between(unit = "m3/s");
  equation
    between = k1*sqrt(max(h1, 0));
    A1*der(h1) = q - between;
    A2*der(h2) = between - k2*sqrt(max(h2, 0));
  end Tank;
end Plants;
