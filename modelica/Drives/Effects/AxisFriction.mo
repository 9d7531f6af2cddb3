within Drives.Effects;
model AxisFriction "Friction of a linear axis beyond viscous and Coulomb"
  extends Translational.PartialFriction;
  parameter Types.Force coulomb_asymmetry = 0 "Coulomb friction more when sliding forward, and less when backward";
  parameter Real viscous_asymmetry(unit = "N.s/m") = 0 "Viscous friction more when sliding forward, and less when backward";
  parameter Types.Force stribeck = 0 "Dry friction at standstill above that when sliding";
  parameter Types.Velocity stribeck_speed(min = 0) = 0.01 "The Stribeck part falls with exp(-(v/stribeck_speed)^2)";
  parameter Real quadratic(unit = "N.s2/m2") = 0 "Friction over speed squared";
  parameter Real slope(unit = "N/m") = 0 "Dry friction over position, 0 at s_mid";
  parameter Types.Position s_mid = 0.12 "Position where the slope adds nothing";
  parameter Real thermal(unit = "1/W") = 0 "All friction falls with exp(-thermal times the warmth)";
  parameter Types.Time thermal_time(min = 0) = 10 "Time constant of warming up";
  Interfaces.RealInput f_port(unit = "N") "Added to the friction";
  Types.Power warmth(start = 0, fixed = true) "Lost power behind the time constant of warming up";
protected
  Types.Force dry "Dry friction, both directions";
  Real cold(unit = "1") "Share of the friction left by warming up";
equation
  der(warmth) = noEvent(if abs(thermal) > 0 then (lossPower - warmth)/thermal_time else 0.0);
  cold = exp(-thermal*warmth);
  dry = Fc + stribeck*exp(-(v/stribeck_speed)^2) + slope*(s - s_mid);
  forward = cold*noEvent(max(0.0, dry + coulomb_asymmetry));
  backward = -cold*noEvent(max(0.0, dry - coulomb_asymmetry));
  fluid = cold*(Fv*v + noEvent(viscous_asymmetry*abs(v) + quadratic*v*abs(v))) + f_port;
end AxisFriction;
