within Pendulum.Friction;
model CoulombViscous "M1: constant, and proportional to speed"
  extends PartialFriction;
equation
  budget = K_c;
  fluid = K_v*w;
end CoulombViscous;
