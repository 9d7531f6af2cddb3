within Drives.Translational;
model Friction "Viscous and Coulomb friction against the ground, and a constant force"
  parameter Types.TranslationalDampingConstant Fv(start = 1) "Viscous friction";
  parameter Types.Force Fc(min = 0, start = 1) "Coulomb friction, also the break-away force";
  parameter Types.Force offset = 0 "Constant force against positive motion";
  parameter Types.Position s_s(min = 0) = 1e-7 "Presliding deflection: the stuck friction deflects by this at break-away";
  Interfaces.TranslationalFlange_a flange "Sliding flange";
  Types.Position s "Absolute position";
  Types.Velocity v "Sliding velocity";
  Types.Power lossPower "Power turned into heat";
  Signals.Bristle bristle "Share of the dry friction that acts";
equation
  s = flange.s;
  v = der(s);
  bristle.v = v/s_s;
  flange.f = Fv*v + Fc*bristle.share + offset;
  lossPower = (flange.f - offset)*v - s_s*der(bristle.z)*Fc*bristle.z;
end Friction;
