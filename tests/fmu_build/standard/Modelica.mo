package Modelica "Stand-in: the names and shapes that models of drives use of the Standard Library, nothing of its text"
  package Units
    package SI
      type Angle = Real(final quantity = "Angle", final unit = "rad", displayUnit = "deg");
      type Torque = Real(final quantity = "Torque", final unit = "N.m");
      type AngularVelocity = Real(final quantity = "AngularVelocity", final unit = "rad/s");
      type AngularAcceleration = Real(final quantity = "AngularAcceleration", final unit = "rad/s2");
      type Inertia = Real(final quantity = "MomentOfInertia", final unit = "kg.m2");
    end SI;
  end Units;

  package Utilities
    package Files
      impure function loadResource
        input String uri;
        output String fileReference;
      external "C" fileReference = ModelicaInternal_fullPathName(uri);
      end loadResource;
    end Files;
  end Utilities;

  package Blocks
    package Types
      type Smoothness = enumeration(LinearSegments, ContinuousDerivative, ConstantSegments);
      type Extrapolation = enumeration(HoldLastPoint, LastTwoPoints, Periodic, NoExtrapolation);

      class ExternalCombiTable1D
        extends ExternalObject;

        function constructor
          input String tableName;
          input String fileName;
          input Real table[:, :];
          input Integer columns[:];
          input Smoothness smoothness;
          input Extrapolation extrapolation = Extrapolation.LastTwoPoints;
          input Boolean verboseRead = true;
          input String delimiter = ",";
          input Integer nHeaderLines = 0;
          output ExternalCombiTable1D self;
        external "C" self = ModelicaStandardTables_CombiTable1D_init3(fileName, tableName, table, size(table, 1),
            size(table, 2), columns, size(columns, 1), smoothness, extrapolation, verboseRead, delimiter, nHeaderLines);
        end constructor;

        function destructor
          input ExternalCombiTable1D self;
        external "C" ModelicaStandardTables_CombiTable1D_close(self);
        end destructor;
      end ExternalCombiTable1D;
    end Types;

    package Tables
      package Internal
        function getTable1DValue
          input Types.ExternalCombiTable1D tableID;
          input Integer icol;
          input Real u;
          output Real y;
        external "C" y = ModelicaStandardTables_CombiTable1D_getValue(tableID, icol, u);
        end getTable1DValue;

        function getTable1DAbscissaUmax
          input Types.ExternalCombiTable1D tableID;
          output Real uMax;
        external "C" uMax = ModelicaStandardTables_CombiTable1D_maximumAbscissa(tableID);
        end getTable1DAbscissaUmax;
      end Internal;

      block CombiTable1Ds "A table over one input, in the Standard Library's manner"
        import Modelica.Blocks.Types.{ExternalCombiTable1D, Extrapolation, Smoothness};
        parameter Real table[:, :];
        parameter Integer columns[:] = 2:size(table, 2);
        parameter Smoothness smoothness = Smoothness.LinearSegments;
        parameter Extrapolation extrapolation = Extrapolation.LastTwoPoints;
        input Real u;
        output Real y[size(columns, 1)];
      protected
        final parameter ExternalCombiTable1D tableID = ExternalCombiTable1D(tableName = "NoName", fileName = "NoName",
          table = table, columns = columns, smoothness = smoothness, extrapolation = extrapolation,
          verboseRead = false);
      equation
        for i in 1:size(columns, 1) loop
          y[i] = Internal.getTable1DValue(tableID, i, u);
        end for;
      end CombiTable1Ds;
    end Tables;
  end Blocks;

  package Mechanics
    package Rotational
      import Modelica.Units.SI;

      package Interfaces
        connector Flange_a
          SI.Angle phi;
          flow SI.Torque tau;
        end Flange_a;

        connector Flange_b
          SI.Angle phi;
          flow SI.Torque tau;
        end Flange_b;

        partial model PartialFriction "Modes of a friction element; what friction it has is left open"
          SI.AngularVelocity w_relfric;
          SI.AngularAcceleration a_relfric;
          SI.Torque tau0;
          SI.Torque tau0_max;
          Boolean free;
          Real sa(final unit = "1");
          Boolean startForward(start = false, fixed = true);
          Boolean startBackward(start = false, fixed = true);
          Boolean locked(start = false);
          constant Integer Unknown = 3;
          constant Integer Free = 2;
          constant Integer Forward = 1;
          constant Integer Stuck = 0;
          constant Integer Backward = -1;
          Integer mode(final min = Backward, final max = Unknown, start = Unknown, fixed = true);
        protected
          constant SI.AngularAcceleration unitAngularAcceleration = 1;
          constant SI.Torque unitTorque = 1;
        equation
          startForward = pre(mode) == Stuck and (sa > tau0_max/unitTorque or pre(startForward) and sa > tau0/unitTorque)
            or initial() and w_relfric > 0;
          startBackward = pre(mode) == Stuck and (sa < -tau0_max/unitTorque or pre(startBackward) and sa < -tau0/unitTorque)
            or initial() and w_relfric < 0;
          locked = not free and not (pre(mode) == Forward or startForward or pre(mode) == Backward or startBackward);
          a_relfric/unitAngularAcceleration = if locked then 0 elseif free then sa
            elseif startForward or not startBackward and pre(mode) == Forward then sa - tau0_max/unitTorque
            else sa + tau0_max/unitTorque;
          mode = if free then Free
            elseif (pre(mode) == Forward or pre(mode) == Free or startForward) and w_relfric > 0 then Forward
            elseif (pre(mode) == Backward or pre(mode) == Free or startBackward) and w_relfric < 0 then Backward
            else Stuck;
        end PartialFriction;
      end Interfaces;

      package Components
        model Inertia
          Interfaces.Flange_a flange_a;
          Interfaces.Flange_b flange_b;
          parameter SI.Inertia J(min = 0, start = 1);
          parameter StateSelect stateSelect = StateSelect.default;
          SI.Angle phi(stateSelect = stateSelect);
          SI.AngularVelocity w(stateSelect = stateSelect);
          SI.AngularAcceleration a;
        equation
          phi = flange_a.phi;
          phi = flange_b.phi;
          w = der(phi);
          a = der(w);
          J*a = flange_a.tau + flange_b.tau;
        end Inertia;

        model BearingFriction "Friction against the ground by a table over speed, in the Standard Library's manner"
          Interfaces.Flange_a flange_a;
          Interfaces.Flange_b flange_b;
          import Modelica.Blocks.Types.{ExternalCombiTable1D, Extrapolation, Smoothness};
          import Modelica.Blocks.Tables.Internal.getTable1DValue;
          parameter Real tau_pos[:, 2] = [0, 1];
          parameter Smoothness smoothness = Smoothness.LinearSegments;
          parameter Real peak(final min = 1) = 1;
          extends Interfaces.PartialFriction;
          SI.Angle phi;
          SI.Torque tau;
          SI.AngularVelocity w;
          SI.AngularAcceleration a;
        protected
          final parameter ExternalCombiTable1D tableID = ExternalCombiTable1D(tableName = "NoName", fileName = "NoName",
            table = tau_pos, columns = {2}, smoothness = smoothness, extrapolation = Extrapolation.LastTwoPoints,
            verboseRead = false);
          Real table_signs[2];
        equation
          tau0 = getTable1DValue(tableID, 1, 0);
          tau0_max = peak*tau0;
          free = false;
          phi = flange_a.phi;
          flange_b.phi = flange_a.phi;
          w = der(phi);
          a = der(w);
          w_relfric = w;
          a_relfric = a;
          flange_a.tau + flange_b.tau - tau = 0;
          table_signs = if startForward then {1, 1} elseif startBackward then {-1, -1}
            elseif pre(mode) == Forward then {1, 1} else {-1, -1};
          tau = if locked then sa*unitTorque else table_signs[2]*getTable1DValue(tableID, 1, table_signs[1]*w);
        end BearingFriction;
      end Components;
    end Rotational;
  end Mechanics;
end Modelica;
