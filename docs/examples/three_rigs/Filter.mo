model Filter "A coil and a capacitor between a source and a load"
  connector Pin
    Real v(unit = "V");
    flow Real i(unit = "A");
  end Pin;
  model Source
    Pin pin;
    input Real u(unit = "V");
  equation
    pin.v = u;
  end Source;
  model Coil
    Pin a, b;
    parameter Real L(unit = "H", min = 0) = 0.01 "Inductance";
    parameter Real R(unit = "Ohm", min = 0) = 2 "Resistance of the winding";
    Real i(unit = "A", start = 0, fixed = true);
  equation
    L*der(i) = a.v - b.v - R*i;
    a.i = i;
    b.i = -i;
  end Coil;
  model Capacitor
    Pin pin;
    parameter Real C(unit = "F", min = 0) = 1e-4 "Capacitance";
    Real v(unit = "V", start = 0, fixed = true);
  equation
    v = pin.v;
    C*der(v) = pin.i;
  end Capacitor;
  model Load
    Pin pin;
    parameter Real R(unit = "Ohm", min = 0) = 40 "Resistance";
  equation
    pin.v = R*pin.i;
  end Load;
  input Real u(unit = "V") "Voltage of the source";
  output Real i(unit = "A") "Current through the coil";
  output Real v(unit = "V") "Voltage at the load";
  Source source;
  Coil coil;
  Capacitor capacitor;
  Load load;
equation
  source.u = u;
  connect(source.pin, coil.a);
  connect(coil.b, capacitor.pin);
  connect(capacitor.pin, load.pin);
  i = coil.i;
  v = capacitor.v;
end Filter;
