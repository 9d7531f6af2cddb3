within Pendulum.Setups;
model PositionDrivenWithEffects "Servo pendulum under its position controller, with the effects of its catalogue and ports"
  import Drives.Types;
  extends PositionDriven(redeclare model MotorModel = Effects.Motor, redeclare model FrictionModel = Effects.JointFriction,
    redeclare model ArmModel = Effects.PayloadArm, redeclare model EncoderModel = Effects.Encoder,
    redeclare model ControllerModel = Effects.Controller);
  extends Effects.Ports;
  input Types.Angle port_reference "Added to the reference angle";
equation
  friction.off = 1 - enable;
  friction.tau_port = port_friction;
  controller.q_port = port_reference;
end PositionDrivenWithEffects;
