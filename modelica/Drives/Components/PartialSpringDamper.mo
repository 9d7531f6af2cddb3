within Drives.Components;
partial model PartialSpringDamper "Spring and damper in parallel; how the torque depends on them is left open"
  extends Interfaces.PartialCompliant;
  parameter Types.RotationalSpringConstant c(start = 1e5) "Spring constant";
  parameter Types.RotationalDampingConstant d(start = 0) "Damping constant";
  parameter Types.Angle phi_rel0 = 0 "Relative angle of the unstretched spring";
end PartialSpringDamper;
