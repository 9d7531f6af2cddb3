model Trolley "A mass on rails, driven by a force: it integrates what the model lacks"
  parameter Real m(unit = "kg") = 2 "Mass";
  parameter Real d(unit = "N.s/m") = 0.5 "Viscous friction";
  input Real f(unit = "N") "Force";
  output Real s(start = 0, fixed = true, unit = "m") "Position";
  Real v(start = 0, fixed = true, unit = "m/s") "Speed";
equation
  der(s) = v;
  m * der(v) = f - d * v;
end Trolley;
