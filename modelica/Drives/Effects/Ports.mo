within Drives.Effects;
partial model Ports "Inputs of a setup that are zero by default and act where an effect would"
  input Types.Current port_current "Added to the commanded current";
  input Types.Torque port_motor_torque "Added to the motor torque";
  input Types.Torque port_gear_friction "Added to the loss torque of the gear";
  input Types.Angle port_flexspline_deflection "Added to the deflection of the Flexspline";
  input Types.Torque port_load_torque "Torque added on the output shaft";
end Ports;
