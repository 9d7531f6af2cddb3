within;
model Chain "Masses in a row, each on a hardening spring and a damper to the one before"
  parameter Integer n = 40 "Number of masses";
  parameter Real m(unit = "kg") = 1.0 "Each mass";
  parameter Real k(unit = "N/m") = 400.0 "Stiffness at rest";
  parameter Real k3(unit = "N/m3") = 4000.0 "Its growth";
  parameter Real c(unit = "N.s/m") = 0.5 "Damping";
  input Real F(unit = "N") "Force on the last mass";
  Real x[n](each unit = "m", each start = 0, each fixed = true);
  Real v[n](each unit = "m/s", each start = 0, each fixed = true);
  Real f[n](each unit = "N") "Force of each spring";
  output Real y(unit = "m") = x[n];
equation
  f[1] = k*x[1] + k3*x[1]^3 + c*v[1];
  for i in 2:n loop
    f[i] = k*(x[i] - x[i - 1]) + k3*(x[i] - x[i - 1])^3 + c*(v[i] - v[i - 1]);
  end for;
  for i in 1:n - 1 loop
    m*der(v[i]) = f[i + 1] - f[i];
  end for;
  m*der(v[n]) = F - f[n];
  for i in 1:n loop
    der(x[i]) = v[i];
  end for;
end Chain;
