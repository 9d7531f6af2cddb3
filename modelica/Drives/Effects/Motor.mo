within Drives.Effects;
model Motor "Motor with dead time, a lagging current loop, saturation and cogging"
  extends Components.PartialMotor;
  parameter Types.Time delay(min = 0) = 0 "Dead time between commanded current and current";
  parameter Types.Time current_lag(min = 0) = 0 "Time constant of the current loop";
  parameter Real saturation(unit = "1/A2", min = 0) = 0 "Inverse square of the current at which the motor saturates";
  parameter Real saturation_exponent(unit = "1", min = 1) = 2 "Sharpness k of the knee: torque per current falls with (1 + |i/i_sat|^k)^(1/k)";
  parameter Types.Torque cogging_sin = 0 "Cogging torque, sine over the rotor angle";
  parameter Types.Torque cogging_cos = 0 "Cogging torque, cosine over the rotor angle";
  parameter Real cogging_order(unit = "1", min = 1) = 12 "Periods of cogging a turn";
  Interfaces.RealInput i_port(unit = "A") "Added to the commanded current";
  Interfaces.RealInput tau_port(unit = "N.m") "Added to the torque";
  Delay dead(T = delay) "Dead time of the command";
  Lag lag(T = current_lag) "Current loop";
protected
  Types.Angle electrical "Rotor angle times cogging order";
equation
  dead.u = i + i_port;
  connect(dead.y, lag.u);
  electrical = cogging_order*(rotor.phi - stator.phi);
  tau = K_m*lag.y/(1 + (saturation*lag.y^2 + 1e-12)^(saturation_exponent/2))^(1/saturation_exponent) + cogging_sin*sin(electrical) + cogging_cos*cos(electrical) + tau_port;
end Motor;
