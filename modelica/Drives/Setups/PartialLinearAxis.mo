within Drives.Setups;
partial model PartialLinearAxis "Ball-screw axis (EMPS): mass with viscous and Coulomb friction, driven by a control signal"
  parameter Types.Mass M = 95 "Moved mass";
  parameter Types.TranslationalDampingConstant Fv = 200 "Viscous friction";
  parameter Types.Force Fc(min = 0) = 20 "Coulomb friction";
  parameter Types.Force offset = 0 "Constant force against positive motion";
  parameter Real gtau(unit = "N/V") = 35.15065188248547 "Force per control signal";
  parameter Types.Position q_start = 0 "Start position";
  parameter Types.Velocity v_start = 0 "Start velocity";
  parameter Types.Position s_s(min = 0) = 1e-7 "Presliding deflection of the friction";
  parameter Types.Time t_s(min = 0) = 3e-3 "Damping time of the stuck friction";
  parameter Real z_e(unit = "1", min = 0, max = 0.999) = 0.9 "Purely elastic share of the presliding deflection";
  output Types.Position qm "Position";
  output Types.Velocity v "Velocity";
  output Types.Force force "Motor force";
  Translational.ForceMotor motor(gtau = gtau) "Drive";
  Translational.Mass mass(M = M, s(start = q_start, fixed = true), v(start = v_start, fixed = true)) "Moved mass";
  Translational.Friction friction(Fv = Fv, Fc = Fc, offset = offset, s_s = s_s, bristle(t_s = t_s, z_e = z_e)) "Friction";
equation
  connect(motor.flange, mass.flange_a);
  connect(mass.flange_b, friction.flange);
  qm = mass.s;
  v = mass.v;
  force = motor.f;
end PartialLinearAxis;
