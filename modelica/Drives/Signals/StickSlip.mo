within Drives.Signals;
block StickSlip "Dry friction by events: stuck, sliding forward or sliding backward"
  parameter Real peak(unit = "1", min = 1) = 1 "Break-away friction over sliding friction at standstill";
  Interfaces.RealInput w(unit = "rad/s") "Sliding speed";
  Interfaces.RealInput forward(unit = "N.m") "Friction if it slides forward";
  Interfaces.RealInput backward(unit = "N.m") "Friction if it slides backward, negative";
  Interfaces.RealOutput friction(unit = "N.m") "Friction";
  Types.AngularAcceleration a "Sliding acceleration";
  Real sa(unit = "1") "Path parameter: friction where stuck, acceleration beyond it where sliding";
  Boolean startForward(start = false, fixed = true) "Breaks away forward";
  Boolean startBackward(start = false, fixed = true) "Breaks away backward";
  Boolean locked(start = false) "Stuck";
  Integer mode(start = 2, fixed = true, min = -1, max = 2) "1 forward, 0 stuck or about to slide, -1 backward, 2 not known yet";
protected
  constant Types.Torque unit_torque = 1;
  constant Types.AngularAcceleration unit_acceleration = 1;
equation
  a = der(w);
  startForward = pre(mode) == 0 and (sa*unit_torque > peak*forward or pre(startForward) and sa*unit_torque > forward)
    or initial() and w > 0;
  startBackward = pre(mode) == 0 and (sa*unit_torque < peak*backward or pre(startBackward) and sa*unit_torque < backward)
    or initial() and w < 0;
  locked = not (pre(mode) == 1 or startForward or pre(mode) == -1 or startBackward);
  friction = if locked then sa*unit_torque elseif pre(mode) == 1 or startForward then forward else backward;
  a = if locked then 0 else unit_acceleration*(sa - friction/unit_torque);
  mode = if (pre(mode) == 1 or startForward) and w > 0 then 1
    elseif (pre(mode) == -1 or startBackward) and w < 0 then -1 else 0;
  annotation(Documentation(info="<html>
<p>The scheme of Otter, Elmqvist and Mattsson (CACSD 1999), as BearingFriction and LossyGear of the Standard Library have
it: where stuck, the acceleration is zero and the friction whatever that takes; it breaks away where that exceeds the
sliding friction (times peak), and sticks again where the speed passes zero.</p>
</html>"));
end StickSlip;
