within Pendulum.Friction;
model Stribeck "M2: M1, and more at standstill"
  extends PartialStribeck;
equation
  budget = K_c + S*K_cs;
  fluid = K_v*w;
end Stribeck;
