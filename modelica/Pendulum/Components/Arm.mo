within Pendulum.Components;
model Arm "Rigid arm with a payload at its end"
  import Drives.Types;
  parameter Types.Mass m = 1 "Payload";
  parameter Types.Mass m_a = 0.078 "Mass of the arm, a slender rod";
  parameter Types.Position l = 0.15 "Length of the arm";
  parameter Types.Position r_g(min = 0) = 0 "Radius of gyration of the payload about its own centre: 0 for a point";
  Drives.Interfaces.Flange_a flange "Axis";
  Types.Angle phi(start = 0, stateSelect = StateSelect.always) "Angle, 0 hanging down";
  Types.AngularVelocity w(start = 0, nominal = 1, stateSelect = StateSelect.always) "Speed";
  Types.AngularAcceleration a(start = 0) "Angular acceleration";
  Types.Torque tau_e "Torque of the weight on the axis";
protected
  constant Types.Acceleration g = 9.80665 "Standard gravity";
  parameter Types.Inertia J = m*(l^2 + r_g^2) + m_a*l^2/3 "Moment of inertia about the axis";
  parameter Types.Torque mgl = (m + m_a/2)*g*l "Weight times distance of its centre of mass";
equation
  phi = flange.phi;
  w = der(phi);
  a = der(w);
  tau_e = -mgl*sin(phi);
  J*a = flange.tau + tau_e;
end Arm;
