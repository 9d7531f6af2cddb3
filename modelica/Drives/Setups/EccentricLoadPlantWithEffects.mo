within Drives.Setups;
model EccentricLoadPlantWithEffects "EccentricLoadPlant with the effects of the catalogue and ports"
  extends EccentricLoadPlant(redeclare model SensorModel = Effects.TorqueSensor, redeclare model MotorModel = Effects.Motor,
    redeclare model GearModel = Effects.HarmonicDrive, redeclare model FlexsplineModel = Effects.Flexspline);
  extends Effects.Ports;
  Effects.OutputTorque shaft "Torque on the output shaft";
equation
  connect(shaft.flange, flexspline.flange_b);
  motor.i_port = port_current;
  motor.tau_port = port_motor_torque;
  gear.tau_port = port_gear_friction;
  flexspline.phi_port = port_flexspline_deflection;
  shaft.tau_port = port_load_torque;
end EccentricLoadPlantWithEffects;
