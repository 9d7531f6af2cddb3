within Drives.Setups;
model LinearAxisClosedLoopWithEffects "Linear axis under its position controller, with the effects of its catalogue and ports"
  extends LinearAxisClosedLoop(redeclare model DriveModel = Effects.AxisMotor, redeclare model MassModel = Effects.AxisMass,
    redeclare model FrictionModel = Effects.AxisFriction);
  extends Effects.AxisPorts;
equation
  motor.f_port = port_motor_force;
  friction.f_port = port_friction;
end LinearAxisClosedLoopWithEffects;
