within Drives;
package Types "SI types with units, as in Modelica.Units.SI"
  type Time = Real(final quantity = "Time", final unit = "s") "Time";
  type Rate = Real(final quantity = "Rate", final unit = "1/s") "Change per second";
  type Angle = Real(final quantity = "Angle", final unit = "rad", displayUnit = "deg") "Angle";
  type AngularVelocity = Real(final quantity = "AngularVelocity", final unit = "rad/s") "Angular velocity";
  type AngularAcceleration = Real(final quantity = "AngularAcceleration", final unit = "rad/s2") "Angular acceleration";
  type Torque = Real(final quantity = "Torque", final unit = "N.m") "Torque";
  type Inertia = Real(final quantity = "MomentOfInertia", final unit = "kg.m2", min = 0) "Moment of inertia";
  type RotationalSpringConstant = Real(final quantity = "RotationalSpringConstant", final unit = "N.m/rad", min = 0)
    "Rotational spring constant";
  type RotationalDampingConstant = Real(final quantity = "RotationalDampingConstant", final unit = "N.m.s/rad", min = 0)
    "Rotational damping constant";
  type TorqueConstant = Real(final quantity = "ElectricalTorqueConstant", final unit = "N.m/A") "Torque per current";
  type Power = Real(final quantity = "Power", final unit = "W") "Power";
  type Current = Real(final quantity = "ElectricCurrent", final unit = "A") "Electric current";
  type Voltage = Real(final quantity = "ElectricPotential", final unit = "V") "Electric potential";
  type Position = Real(final quantity = "Length", final unit = "m") "Position";
  type Velocity = Real(final quantity = "Velocity", final unit = "m/s") "Velocity";
  type Acceleration = Real(final quantity = "Acceleration", final unit = "m/s2") "Acceleration";
  type Force = Real(final quantity = "Force", final unit = "N") "Force";
  type Mass = Real(final quantity = "Mass", final unit = "kg", min = 0) "Mass";
  type TranslationalDampingConstant = Real(final quantity = "TranslationalDampingConstant", final unit = "N.s/m", min = 0)
    "Translational damping constant";
end Types;
