within Pendulum.Effects;
model PayloadArm "Arm whose weight is not quite known, on a bench that may be tilted; the payload may swing"
  extends Components.PartialArm;
  import Drives.Types;
  parameter Real weight(unit = "1") = 1 "Weight over the nominal one";
  parameter Types.Angle tilt = 0 "Angle of the arm when it hangs down";
  parameter Real share(unit = "1", min = 0, max = 0.95) = 0 "Share of the inertia that sits on a spring";
  parameter Real frequency(unit = "Hz", min = 0) = 10 "Natural frequency of that share";
  parameter Real damping(unit = "1", min = 0) = 0.1 "Damping ratio of that share";
  Types.Angle phi_rel(start = 0, fixed = true) "Deflection of the spring";
  Types.AngularVelocity w_rel(start = 0, fixed = true) "Speed of the share relative to the arm";
protected
  constant Real pi = 3.141592653589793 "Half the circumference of the unit circle";
  parameter Types.Rate omega = 2*pi*frequency "Natural angular frequency";
  Types.AngularAcceleration pull "Pull of the spring and damper over the inertia on it";
equation
  tau_e = -weight*mgl*sin(phi - tilt);
  pull = omega*omega*phi_rel + 2*damping*omega*w_rel;
  der(phi_rel) = noEvent(if share > 0 then w_rel else 0.0);
  der(w_rel) = noEvent(if share > 0 then -pull - a else 0.0);
  (1 - share)*J*a = flange.tau + tau_e + share*J*pull;
end PayloadArm;
