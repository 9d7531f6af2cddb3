within Drives.Functions;
function bristleRate "Time derivative of a normalised elasto-plastic bristle"
  input Types.Rate v "Sliding speed over presliding deflection";
  input Real z "Deflection of the bristle over the presliding deflection";
  input Real z_e "Purely elastic below this deflection, 0 <= z_e < 1";
  output Types.Rate dz "Time derivative of z";
protected
  Real plastic "Share of the motion that slides: 0 up to z_e, 1 at full deflection";
algorithm
  plastic := (max(0.0, abs(z) - z_e)/(1 - z_e))^2;
  dz := v - (if z*v > 0 then plastic*v else 0.0);
end bristleRate;
