model TwoLinkArm "Two links in a horizontal plane, driven at shoulder and elbow"
  connector Flange "Rotational"
    Real phi(unit="rad");
    flow Real tau(unit="N.m");
  end Flange;
  model Motor
    Flange shaft;
    input Real tau(unit="N.m");
  equation
    shaft.tau = -tau;
  end Motor;
  model Joint "Bearings and gear of a joint"
    Flange shaft;
    parameter Real d(unit="N.m.s/rad", min=0) = 1 "Viscous friction", F(unit="N.m", min=0) = 1 "Dry friction";
  equation
    shaft.tau = d*der(shaft.phi) + F*tanh(der(shaft.phi)/0.02);
  end Joint;
  model Stop "Rubber on both sides of the shoulder"
    Flange shaft;
    parameter Real c(unit="N.m/rad", min=0) = 25 "Stiffness";
  equation
    shaft.tau = c*(max(shaft.phi - 2, 0) + min(shaft.phi + 2, 0));
  end Stop;
  model Links
    Flange shoulder, elbow;
    parameter Real I1(unit="kg.m2", min=0) = 1.2 "Inertia of both about the shoulder, less the coupled part";
    parameter Real I2(unit="kg.m2", min=0) = 0.25 "Inertia of the forearm about the elbow";
    parameter Real h(unit="kg.m2", min=0) = 0.3 "Coupling of the links";
    Real q1(unit="rad", start=0, fixed=true), w1(unit="rad/s", start=0, fixed=true);
    Real q2(unit="rad", start=0.5, fixed=true), w2(unit="rad/s", start=0, fixed=true);
  equation
    q1 = shoulder.phi;
    q2 = elbow.phi;
    w1 = der(q1);
    w2 = der(q2);
    shoulder.tau = (I1 + 2*h*cos(q2))*der(w1) + (I2 + h*cos(q2))*der(w2) - h*sin(q2)*(2*w1*w2 + w2^2);
    elbow.tau = (I2 + h*cos(q2))*der(w1) + I2*der(w2) + h*sin(q2)*w1^2;
  end Links;
  input Real tau1(unit="N.m") "Torque at the shoulder";
  input Real tau2(unit="N.m") "Torque at the elbow";
  output Real q1(unit="rad") "Encoder of the shoulder";
  output Real q2(unit="rad") "Encoder of the elbow";
  Motor first; Motor second; Joint shoulder(d=1.5, F=1.0); Joint elbow(d=0.5, F=0.4); Stop stop; Links links;
equation
  first.tau = tau1;
  second.tau = tau2;
  connect(first.shaft, links.shoulder);
  connect(second.shaft, links.elbow);
  connect(shoulder.shaft, links.shoulder);
  connect(elbow.shaft, links.elbow);
  connect(stop.shaft, links.shoulder);
  q1 = links.q1;
  q2 = links.q2;
end TwoLinkArm;
