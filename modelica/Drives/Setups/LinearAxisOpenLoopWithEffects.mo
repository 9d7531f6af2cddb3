within Drives.Setups;
model LinearAxisOpenLoopWithEffects "Linear axis driven by a given control signal, with the effects of its catalogue and ports"
  extends LinearAxisOpenLoop(redeclare model DriveModel = Effects.AxisMotor, redeclare model MassModel = Effects.AxisMass,
    redeclare model FrictionModel = Effects.AxisFriction);
  extends Effects.AxisPorts;
equation
  motor.f_port = port_motor_force;
  friction.f_port = port_friction;
end LinearAxisOpenLoopWithEffects;
