within Pendulum.Components;
model Encoder "Encoder with an offset"
  extends PartialEncoder;
equation
  q = phi + offset;
end Encoder;
