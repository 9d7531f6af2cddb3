within Drives.Signals;
block SpeedController "PI speed controller with limited current; the integral is held while limited"
  parameter Real kp(unit = "A.s/rad", start = 0.02) "Proportional gain";
  parameter Real ki(unit = "A/rad", start = 0.4) "Integral gain";
  parameter Types.Current i_max(min = 0, start = 6) "Largest current";
  parameter Types.Current integral_start = 0 "Start value of the integral part";
  Interfaces.RealInput w_ref(unit = "rad/s") "Reference speed";
  Interfaces.RealInput w(unit = "rad/s") "Measured speed";
  Interfaces.RealOutput i(unit = "A") "Commanded current";
  Types.Current integral(start = integral_start, fixed = true) "Integral part of the current";
protected
  constant Real fade = 1e-3 "The integral stops within this share of i_max beyond the limit";
  Types.Current command "Current before the limit";
equation
  command = kp*(w_ref - w) + integral;
  der(integral) = ki*(w_ref - w)*noEvent(max(0.0, min(1.0, 1 + (1 - abs(command)/i_max)/fade)));
  i = noEvent(max(-i_max, min(i_max, command)));
end SpeedController;
