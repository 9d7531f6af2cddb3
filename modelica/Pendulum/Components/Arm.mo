within Pendulum.Components;
model Arm "Rigid arm with a payload at its end"
  extends PartialArm;
equation
  tau_e = -mgl*sin(phi);
  J*a = flange.tau + tau_e;
end Arm;
