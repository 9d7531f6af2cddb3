within Pendulum.Components;
model Motor "Torque as demanded, up to a limit"
  extends PartialMotor;
equation
  tau = gain*noEvent(max(-tau_max, min(tau_max, u)));
end Motor;
