within Pendulum.Effects;
partial model Ports "Inputs of a setup that are zero by default and act where an effect would"
  import Drives.Types;
  input Types.Torque port_friction "Added to the friction of the joint";
end Ports;
