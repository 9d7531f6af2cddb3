within Drives.Effects;
model AxisMass "Sliding mass of which a share sits on a spring"
  extends Translational.PartialMass;
  parameter Real share(unit = "1", min = 0, max = 0.95) = 0 "Share of the mass that sits on a spring";
  parameter Real frequency(unit = "Hz", min = 0) = 30 "Natural frequency of that share";
  parameter Real damping(unit = "1", min = 0) = 0.1 "Damping ratio of that share";
  Types.Position s_rel(start = 0, fixed = true) "Deflection of the spring";
  Types.Velocity v_rel(start = 0, fixed = true) "Velocity of the share relative to the rest";
protected
  constant Real pi = 3.141592653589793 "Half the circumference of the unit circle";
  parameter Types.Rate omega = 2*pi*frequency "Natural angular frequency";
  Types.Acceleration pull "Pull of the spring and damper over the mass on it";
equation
  pull = omega*omega*s_rel + 2*damping*omega*v_rel;
  der(s_rel) = noEvent(if share > 0 then v_rel else 0.0);
  der(v_rel) = noEvent(if share > 0 then -pull - a else 0.0);
  (1 - share)*M*a = flange_a.f + flange_b.f + share*M*pull;
end AxisMass;
