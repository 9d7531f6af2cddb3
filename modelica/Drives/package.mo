package Drives "Drive trains with lossy gears: a Harmonic Drive actuator and a linear axis"
  annotation(Documentation(info="<html>
<p>Acausal components with (phi, flow tau) and (s, flow f) flanges as in the Modelica Standard Library, and the
experiment models (Setups) that are exported as FMUs. Actuator: Peer, Bajcinca, Schweiger, 3rd International
Modelica Conference, 2003.</p>
</html>"));
end Drives;
