within Pendulum.Friction;
model Directional "M5: M4, where the torques of motor and load count differently"
  extends PartialDirectional;
equation
  budget = K_c + linear;
  fluid = K_v*w;
end Directional;
