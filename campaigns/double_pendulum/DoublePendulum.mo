model DoublePendulum "Two links that hang from a wall, with a motor and a gear in each joint"
  connector Joint "An angle, and the torque that turns it"
    Real phi(unit = "rad");
    flow Real tau(unit = "N.m");
  end Joint;

  model Motor "Makes the torque that it is told"
    Joint joint;
    input Real tau(unit = "N.m") "Torque behind the gear";
  equation
    joint.tau = -tau;
  end Motor;

  model Friction "Viscous and Coulomb friction; the latter rounded off below w_0, as the authors of the rig have it"
    Joint joint;
    parameter Real b(unit = "N.m.s/rad", min = 0) = 0.01 "Viscous friction";
    parameter Real f(unit = "N.m", min = 0) = 0.1 "Coulomb friction";
    constant Real pi = 3.141592653589793;
    constant Real w_0(unit = "rad/s") = 0.01 "Speed at which Coulomb friction has half its size";
    Real w(unit = "rad/s") "Speed";
  equation
    w = der(joint.phi);
    joint.tau = b*w + f*2/pi*atan(w/w_0);
  end Friction;

  model Links "Two links in a plane; rotors turn with their joints"
    Joint shoulder "Angle of the first link, 0 hanging down";
    Joint elbow "Angle of the second link against the first";
    parameter Real m1(unit = "kg", min = 0) = 0.5 "Mass of the first link";
    parameter Real m2(unit = "kg", min = 0) = 0.6 "Mass of the second link";
    parameter Real r1(unit = "m", min = 0) = 0.2 "Shoulder to the first link's centre of mass";
    parameter Real r2(unit = "m", min = 0) = 0.25 "Elbow to the second link's centre of mass";
    parameter Real l1(unit = "m", min = 0) = 0.2 "Shoulder to elbow";
    parameter Real I1(unit = "kg.m2", min = 0) = 0.03 "Inertia of the first link about the shoulder";
    parameter Real I2(unit = "kg.m2", min = 0) = 0.05 "Inertia of the second link about the elbow";
    parameter Real I_r(unit = "kg.m2", min = 0) = 6.3e-5 "Inertia of a rotor";
    parameter Real ratio = 6 "Of the gears";
    constant Real g(unit = "m/s2") = 9.81 "Gravity";
    Real q1(start = 0, fixed = true, unit = "rad");
    Real q2(start = 0, fixed = true, unit = "rad");
    Real w1(start = 0, fixed = true, unit = "rad/s");
    Real w2(start = 0, fixed = true, unit = "rad/s");
    Real h(unit = "kg.m2") "Coupling of the links";
    Real s(unit = "kg.m2") "Its slope";
  equation
    q1 = shoulder.phi;
    q2 = elbow.phi;
    w1 = der(q1);
    w2 = der(q2);
    h = m2*l1*r2*cos(q2);
    s = m2*l1*r2*sin(q2);
    (I1 + I2 + m2*l1^2 + 2*h + (ratio^2 + 1)*I_r)*der(w1) + (I2 + h - ratio*I_r)*der(w2) =
      shoulder.tau + s*(2*w1*w2 + w2^2) - g*(m1*r1 + m2*l1)*sin(q1) - g*m2*r2*sin(q1 + q2);
    (I2 + h - ratio*I_r)*der(w1) + (I2 + ratio^2*I_r)*der(w2) = elbow.tau - s*w1^2 - g*m2*r2*sin(q1 + q2);
  end Links;

  input Real tau1(unit = "N.m") "Torque at the shoulder";
  input Real tau2(unit = "N.m") "Torque at the elbow";
  output Real q1(unit = "rad") "Angle of the first link, 0 hanging down";
  output Real q2(unit = "rad") "Angle of the second link against the first";
  Motor shoulder;
  Motor elbow;
  Friction friction1;
  Friction friction2;
  Links links;
equation
  shoulder.tau = tau1;
  elbow.tau = tau2;
  q1 = links.q1;
  q2 = links.q2;
  connect(shoulder.joint, links.shoulder);
  connect(friction1.joint, links.shoulder);
  connect(elbow.joint, links.elbow);
  connect(friction2.joint, links.elbow);
end DoublePendulum;
