within Drives.Effects;
partial model AxisPorts "Inputs of a linear axis that are zero by default and act where an effect would"
  input Types.Force port_motor_force "Added to the motor force";
  input Types.Force port_friction "Added to the friction";
end AxisPorts;
