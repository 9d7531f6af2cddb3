within Pendulum.Friction;
model Quadratic "M6: M5, and at standstill a part that grows with the square of the torque that resists"
  extends PartialQuadratic;
equation
  budget = K_c + linear + quadratic;
  fluid = K_v*w;
end Quadratic;
