within Drives;
package Effects "What the plain actuator leaves out; every effect is off at its neutral value"
  annotation(Documentation(info="<html>
<p>The catalogue that says which parameters make up an effect is effects.toml beside this package. A state that only an
effect needs stands still while the effect is off, so that a neutral model takes the steps of the plain one.</p>
</html>"));
end Effects;
