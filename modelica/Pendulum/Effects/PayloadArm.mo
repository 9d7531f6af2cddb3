within Pendulum.Effects;
model PayloadArm "Arm whose weight is not quite known, on a bench that may be tilted, behind a gear that may bend"
  extends Components.PartialArm;
  import Drives.Types;
  parameter Real weight(unit = "1") = 1 "Weight over the nominal one";
  parameter Types.Angle tilt = 0 "Angle of the arm when it hangs down";
  parameter Real compliance(unit = "rad/(N.m)", min = 0) = 0 "Deflection between joint and arm over the torque that the joint transmits";
  parameter Real damping(unit = "1", min = 0) = 0.2 "Damping ratio of the arm on that spring while the joint stands";
  Types.Angle phi_rel(start = 0, fixed = true) "Angle of the arm beyond that of the joint";
  Types.AngularVelocity w_rel(start = 0, fixed = true) "Speed of the arm beyond that of the joint";
protected
  Real stiffness(unit = "N.m/rad") "Stiffness between joint and arm";
equation
  tau_e = -weight*mgl*sin(phi + phi_rel - tilt);
  stiffness = 1/noEvent(max(compliance, 1e-6));
  flange.tau = noEvent(if compliance > 0 then -stiffness*phi_rel - 2*damping*sqrt(J*stiffness)*w_rel else J*a - tau_e);
  der(phi_rel) = noEvent(if compliance > 0 then w_rel else 0.0);
  der(w_rel) = noEvent(if compliance > 0 then (flange.tau + tau_e)/J - a else 0.0);
end PayloadArm;
