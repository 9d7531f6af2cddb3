within Drives.Components;
model SpringDamper "Linear spring and damper in parallel"
  extends PartialSpringDamper;
equation
  tau = c*(phi_rel - phi_rel0) + d*w_rel;
end SpringDamper;
