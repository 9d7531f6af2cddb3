package Pendulum "One-joint servo pendulum: motor, gear, friction, arm and payload"
  annotation(Documentation(info="<html>
<p>A bench on which a servo turns an arm with a payload, 0 hanging down. To copy from: the flanges, types, inertia and
bristle come from Drives; what is here is what this rig has of its own. Friction laws after Duclusaud, Passault and others,
Extended Friction Models for the Physics Simulation of Servo Actuators, 2025.</p>
</html>"));
end Pendulum;
