model Drives "Two motors, a belt and a pulley on springs: voltage in, belt speed out"
  parameter Real k(unit="1", min=0) = 1 "Gain";
  parameter Real T(unit="s", min=1e-3) = 0.3 "Time constant of the drives";
  parameter Real w0(unit="rad/s", min=0.1) = 10 "Frequency of the pulley on its springs";
  parameter Real D(unit="1", min=0) = 0.2 "Its damping ratio";
  input Real u(unit="V") "Voltage of both motors";
  output Real y(unit="V", start=0, fixed=true) "Speed signal";
  Real x(unit="V", start=0, fixed=true);
  Real v(unit="V/s", start=0, fixed=true);
equation
  T*der(x) = k*u - x;
  der(y) = v;
  der(v) = w0^2*(x - y) - 2*D*w0*v;
end Drives;
