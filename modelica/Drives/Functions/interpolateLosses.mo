within Drives.Functions;
function interpolateLosses "Row of a loss table at a speed: linear between the rows, constant outside them"
  input Types.AngularVelocity speed "Absolute value of the relative angular velocity";
  input Real lossTable[:, 5] "Rows of speed (strictly increasing), eta1, eta2, tau_bf1, tau_bf2";
  output Real losses[4] "eta1, eta2, tau_bf1, tau_bf2 at that speed";
protected
  Real weight "Share of the way from row k to row k + 1";
algorithm
  losses := lossTable[1, 2:5];
  for k in 1:size(lossTable, 1) - 1 loop
    weight := max(0.0, min(1.0, (speed - lossTable[k, 1])/(lossTable[k + 1, 1] - lossTable[k, 1])));
    for j in 1:4 loop
      losses[j] := losses[j] + weight*(lossTable[k + 1, j + 1] - lossTable[k, j + 1]);
    end for;
  end for;
  annotation(Documentation(info="<html>
<p>Written as a sum of clipped ramps: no search, and the same operations at every speed.</p>
</html>"));
end interpolateLosses;
