within Pendulum;
package Effects "What the plain servo pendulum leaves out; every effect is off at its neutral value"
  annotation(Documentation(info="<html>
<p>The catalogue that says which parameters make up an effect is effects.toml beside this package.</p>
</html>"));
end Effects;
