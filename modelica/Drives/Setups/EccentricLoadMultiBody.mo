within Drives.Setups;
model EccentricLoadMultiBody "EccentricLoad with the mass as a body in space; needs the Modelica Standard Library"
  extends PartialSpeedControlled(J_L = 0.5);
  parameter Types.Torque mgr = 25 "Weight times eccentricity of the load, the largest load torque";
  parameter Real m(unit = "kg") = 20 "Mass of the load";
  final parameter Real r(unit = "m") = mgr/(m*world.g) "Eccentricity of its centre of mass";
  output Types.Angle phi_load "Angle of the load, 0 with the mass hanging down";
  inner Modelica.Mechanics.MultiBody.World world(enableAnimation = false, g = 9.81, n = {0, -1, 0}) "Gravity along -y";
  Modelica.Mechanics.MultiBody.Joints.Revolute bearing(useAxisFlange = true, n = {0, 0, 1}, animation = false,
    phi(start = phi_load_start, fixed = true), w(start = w_motor_start/n, fixed = true)) "Output bearing";
  Modelica.Mechanics.MultiBody.Parts.Body load(m = m, r_CM = {0, -r, 0}, I_33 = J_L - m*r^2, animation = false)
    "Eccentric mass";
equation
  connect(world.frame_b, bearing.frame_a);
  connect(bearing.frame_b, load.frame_a);
  connect(flexspline.flange_b, bearing.axis);
  phi_load = bearing.phi;
  annotation(experiment(StartTime = 0, StopTime = 50, Interval = 1e-2, Tolerance = 1e-6));
end EccentricLoadMultiBody;
