within Drives.Effects;
model Flexspline "Compliance with backlash, hardening and rate-independent hysteresis"
  extends Components.PartialSpringDamper;
  parameter Types.Angle backlash(min = 0) = 0 "Lost motion";
  parameter Real backlash_pull(unit = "1", min = 0, max = 1) = 0 "Share of the torque by which teeth with play pull while the damper holds them";
  parameter Real hardening(unit = "1") = 0 "Share by which the secant stiffness grows up to phi_hard beyond the onset";
  parameter Types.Angle hardening_onset(min = 0) = 0 "Wind-up from which the torque grows faster";
  parameter Real hardening_exponent(unit = "1", min = 1) = 3 "Exponent of the torque beyond the onset: 2 for a stiffness that rises evenly, 3 for a cubic law";
  parameter Types.Angle phi_hard(min = 0) = 1e-3 "Wind-up that hardening refers to";
  parameter Types.Torque hysteresis(min = 0) = 0 "Torque of the hysteresis when it is wound up";
  parameter Types.Angle hysteresis_angle(min = 0) = 3e-4 "The hysteresis is wound up over some of these";
  Interfaces.RealInput phi_port(unit = "rad") "Deflection added to that of the spring";
  Types.Angle wind "Deflection of the spring";
  Real z(start = 0, fixed = true, nominal = 1, unit = "1") "Hysteresis torque over its largest value, Bouc-Wen";
protected
  Types.Angle deflection "Relative angle before backlash";
  Types.Torque pressing "Torque of spring and damper; teeth with play press, and may pull a little";
  Types.Angle beyond "Wind-up beyond the onset of hardening";
  Real contact(unit = "1") "0 within the backlash, 1 in contact";
equation
  deflection = phi_rel - phi_rel0 + phi_port;
  wind = deflection - noEvent(max(-backlash/2, min(backlash/2, deflection)));
  contact = noEvent(if backlash > 0 then min(1.0, abs(wind)/max(0.02*backlash, 1e-9)) else 1.0);
  der(z) = noEvent(if hysteresis > 0 then (w_rel - (if w_rel*z > 0 then abs(z)*w_rel else 0.0))/hysteresis_angle else 0.0);
  beyond = wind - noEvent(max(-hardening_onset, min(hardening_onset, wind)));
  pressing = c*wind + c*hardening*beyond*((beyond/phi_hard)^2 + 1e-12)^((hardening_exponent - 1)/2) + d*contact*w_rel;
  tau = hysteresis*z + noEvent(if not backlash > 0 then pressing elseif wind > 0 then max(backlash_pull*pressing, pressing) else min(backlash_pull*pressing, pressing));
end Flexspline;
