model Oscillator "Driven oscillator"
  parameter Real m(unit = "kg") = 1 "mass";
  parameter Real d(unit = "N.s/m") = 0.5 "damping";
  parameter Real c(unit = "N/m") = 100 "stiffness";
  parameter Real gain = 1 "of the sensor";
  parameter Real spare = 3 "moves nothing";
  parameter Integer mode = 1 "a whole number";
  input Real u(unit = "N", start = 0) "driving force";
  input Real wind(unit = "N", start = 0) "another force";
  output Real x(unit = "m", start = 0.1, fixed = true) "position";
  output Real y(unit = "V") "sensor";
protected
  Real v(unit = "m/s", start = 0, fixed = true) "speed";
equation
  der(x) = v;
  m*der(v) = u + wind - d*v - c*x;
  y = gain*x;
annotation(experiment(StopTime = 1, Interval = 0.002));
end Oscillator;
