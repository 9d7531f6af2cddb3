within Drives.Components;
model SpringDamper "Linear spring and damper in parallel"
  extends Interfaces.PartialCompliant;
  parameter Types.RotationalSpringConstant c(start = 1e5) "Spring constant";
  parameter Types.RotationalDampingConstant d(start = 0) "Damping constant";
  parameter Types.Angle phi_rel0 = 0 "Relative angle of the unstretched spring";
equation
  tau = c*(phi_rel - phi_rel0) + d*w_rel;
end SpringDamper;
