model TwoResistors "A voltage divider that is loaded by a capacitor"
  parameter Real R1(unit = "Ohm", start = 800) "from the source to the node";
  parameter Real R2(unit = "Ohm", start = 2500) "from the node to ground";
  parameter Real C(unit = "F", start = 2e-3) "from the node to ground";
  input Real u(unit = "V", start = 0) "source";
  output Real v(unit = "V", start = 0, fixed = true) "of the node";
protected
  Real i1(unit = "A") "through R1";
  Real i2(unit = "A") "through R2";
equation
  R1*i1 = u - v;
  R2*i2 = v;
  C*der(v) = i1 - i2;
end TwoResistors;
