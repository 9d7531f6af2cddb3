within Pendulum.Setups;
model TorqueDrivenWithEffects "Servo pendulum under a given torque, with the effects of its catalogue and ports"
  extends TorqueDriven(redeclare model MotorModel = Effects.Motor, redeclare model FrictionModel = Effects.JointFriction,
    redeclare model ArmModel = Effects.PayloadArm, redeclare model EncoderModel = Effects.Encoder);
  extends Effects.Ports;
equation
  friction.off = 0;
  friction.tau_port = port_friction;
end TorqueDrivenWithEffects;
