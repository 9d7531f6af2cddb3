model Shaker "A voice coil shakes a table on a suspension; a specimen stands on it on a rubber mount"
  connector Flange "Translational"
    Real s(unit="m");
    flow Real f(unit="N");
  end Flange;
  model Coil
    Flange flange;
    parameter Real k(unit="N/A") = 10 "Force constant";
    input Real i(unit="A");
  equation
    flange.f = -k*i;
  end Coil;
  model Mass
    Flange flange;
    parameter Real m(unit="kg", min=0) "Mass";
    Real s(unit="m", start=0, fixed=true), v(unit="m/s", start=0, fixed=true);
  equation
    s = flange.s;
    v = der(s);
    m*der(v) = flange.f;
  end Mass;
  model Spring
    Flange a, b;
    parameter Real c(unit="N/m", min=0) "Stiffness", d(unit="N.s/m", min=0) "Damping";
    Real stretch(unit="m");
  equation
    stretch = b.s - a.s;
    b.f = c*stretch + d*der(stretch);
    a.f = -b.f;
  end Spring;
  model Frame
    Flange flange;
  equation
    flange.s = 0;
  end Frame;
  input Real i(unit="A") "Current of the coil";
  output Real s_table(unit="m") "Laser at the table";
  output Real s_specimen(unit="m") "Laser at the specimen";
  Coil coil;
  Mass table(m=0.5), specimen(m=0.2);
  Spring suspension(c=2000, d=10), mount(c=3000, d=3);
  Frame frame;
equation
  coil.i = i;
  connect(frame.flange, suspension.a);
  connect(suspension.b, table.flange);
  connect(coil.flange, table.flange);
  connect(table.flange, mount.a);
  connect(mount.b, specimen.flange);
  s_table = table.s;
  s_specimen = specimen.s;
end Shaker;
