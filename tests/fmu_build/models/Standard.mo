package Standard "Models between Drives and the Standard Library's interfaces"
  model Coupled "An inertia and friction of the Standard Library on a spring of Drives"
    Modelica.Mechanics.Rotational.Components.Inertia left(J = 2, phi(start = 0.1, fixed = true), w(fixed = true));
    Drives.Components.SpringDamper spring(c = 300, d = 0);
    Drives.Components.Inertia right(J = 1, phi(fixed = true), w(fixed = true));
    output Modelica.Units.SI.Angle twist = spring.phi_rel;
  equation
    connect(left.flange_b, spring.flange_a);
    connect(spring.flange_b, right.flange_a);
  end Coupled;

  model Bearing "Its friction element with a table"
    Drives.Components.Torque torque;
    Modelica.Mechanics.Rotational.Components.Inertia inertia(J = 0.1, phi(fixed = true), w(fixed = true));
    Modelica.Mechanics.Rotational.Components.BearingFriction bearing(tau_pos = [0, 1; 10, 1.5], peak = 1.2);
    input Modelica.Units.SI.Torque u;
    output Modelica.Units.SI.AngularVelocity w = inertia.w;
    output Integer mode = bearing.mode;
  equation
    torque.tau = u;
    connect(torque.flange, inertia.flange_a);
    connect(inertia.flange_b, bearing.flange_a);
  end Bearing;

  model Table "Values of a table"
    import Modelica.Blocks.Types.*;
    parameter Real table[:, 3] = [0, 1, 10; 1, 3, 20; 3, 4, 40];
    parameter Smoothness smoothness = Smoothness.LinearSegments;
    parameter Extrapolation extrapolation = Extrapolation.LastTwoPoints;
    parameter String file = "NoName";
    input Real u;
    output Real y[2];
    output Real last = Modelica.Blocks.Tables.Internal.getTable1DAbscissaUmax(tableID);
  protected
    parameter ExternalCombiTable1D tableID = ExternalCombiTable1D(tableName = if file == "NoName" then "NoName" else "tab",
      fileName = file, table = table, columns = {2, 3}, smoothness = smoothness, extrapolation = extrapolation);
  equation
    for i in 1:2 loop
      y[i] = Modelica.Blocks.Tables.Internal.getTable1DValue(tableID, i, u);
    end for;
  end Table;

  model Held = Table(extrapolation = Modelica.Blocks.Types.Extrapolation.HoldLastPoint);
  model Steps = Table(smoothness = Modelica.Blocks.Types.Smoothness.ConstantSegments);
  model Akima = Table(smoothness = Modelica.Blocks.Types.Smoothness.ContinuousDerivative,
    table = [0, 0, 1; 1, 0, 3; 3, 0, 4; 4, 0, 4; 6, 0, -2; 7, 0, 0]);
  model Periodic = Table(extrapolation = Modelica.Blocks.Types.Extrapolation.Periodic);
  model FromFile = Table(file = Modelica.Utilities.Files.loadResource("modelica://Standard/table.txt"));
  model NoFile = Table(file = Modelica.Utilities.Files.loadResource("modelica://Standard/none.txt"));
end Standard;
