within Drives.Translational;
partial model PartialFriction "Friction against the ground, and a constant force; its dependence on speed is left open"
  parameter Types.TranslationalDampingConstant Fv(start = 1) "Viscous friction";
  parameter Types.Force Fc(min = 0, start = 1) "Coulomb friction, also the break-away force";
  parameter Types.Force offset = 0 "Constant force against positive motion";
  parameter Types.Position s_s(min = 0) = 1e-7 "Presliding deflection: the stuck friction deflects by this at break-away";
  Interfaces.TranslationalFlange_a flange "Sliding flange";
  Types.Position s "Absolute position";
  Types.Velocity v "Sliding velocity";
  Types.Power lossPower "Power turned into heat";
  Signals.Bristle bristle "Share of the dry friction that acts";
protected
  Types.Force forward "Dry friction if it slides forward";
  Types.Force backward "Dry friction if it slides backward, negative";
  Types.Force fluid "Friction that vanishes at standstill";
equation
  s = flange.s;
  v = der(s);
  bristle.v = v/s_s;
  flange.f = fluid + forward*noEvent(max(0.0, bristle.share)) + backward*noEvent(max(0.0, -bristle.share)) + offset;
  lossPower = (flange.f - offset)*v - s_s*der(bristle.z)*(forward*noEvent(max(0.0, bristle.z)) + backward*noEvent(max(0.0, -bristle.z)));
end PartialFriction;
