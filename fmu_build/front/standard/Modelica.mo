package Modelica "Names that everybody imports, for models without the Modelica Standard Library: units, constants, functions, connectors"
  // Written from the facts: the units of the SI, the constants of CODATA, and the shapes of the connectors.

  package Units
    package SI "Physical quantities in units of the SI"
      type Angle = Real(final quantity = "Angle", final unit = "rad", displayUnit = "deg");
      type SolidAngle = Real(final quantity = "SolidAngle", final unit = "sr");
      type Length = Real(final quantity = "Length", final unit = "m");
      type PathLength = Real(final quantity = "PathLength", final unit = "m");
      type Position = Real(final quantity = "Position", final unit = "m");
      type Distance = Real(final quantity = "Length", final unit = "m", min = 0);
      type Breadth = Real(final quantity = "Length", final unit = "m", min = 0);
      type Height = Real(final quantity = "Length", final unit = "m", min = 0);
      type Thickness = Real(final quantity = "Length", final unit = "m", min = 0);
      type Radius = Real(final quantity = "Length", final unit = "m", min = 0);
      type Diameter = Real(final quantity = "Length", final unit = "m", min = 0);
      type Area = Real(final quantity = "Area", final unit = "m2");
      type Volume = Real(final quantity = "Volume", final unit = "m3");
      type Time = Real(final quantity = "Time", final unit = "s");
      type Duration = Real(final quantity = "Time", final unit = "s");
      type AngularVelocity = Real(final quantity = "AngularVelocity", final unit = "rad/s");
      type AngularAcceleration = Real(final quantity = "AngularAcceleration", final unit = "rad/s2");
      type AngularJerk = Real(final quantity = "AngularJerk", final unit = "rad/s3");
      type Velocity = Real(final quantity = "Velocity", final unit = "m/s");
      type Acceleration = Real(final quantity = "Acceleration", final unit = "m/s2");
      type Jerk = Real(final quantity = "Jerk", final unit = "m/s3");
      type Period = Real(final quantity = "Time", final unit = "s");
      type Frequency = Real(final quantity = "Frequency", final unit = "Hz");
      type AngularFrequency = Real(final quantity = "AngularFrequency", final unit = "rad/s");
      type Wavelength = Real(final quantity = "Wavelength", final unit = "m");
      type DampingCoefficient = Real(final quantity = "DampingCoefficient", final unit = "s-1");
      type Mass = Real(final quantity = "Mass", final unit = "kg", min = 0);
      type Density = Real(final quantity = "Density", final unit = "kg/m3", min = 0);
      type RelativeDensity = Real(final quantity = "RelativeDensity", final unit = "1");
      type SpecificVolume = Real(final quantity = "SpecificVolume", final unit = "m3/kg");
      type LinearDensity = Real(final quantity = "LinearDensity", final unit = "kg/m");
      type Momentum = Real(final quantity = "Momentum", final unit = "kg.m/s");
      type AngularMomentum = Real(final quantity = "AngularMomentum", final unit = "kg.m2/s");
      type Impulse = Real(final quantity = "Impulse", final unit = "N.s");
      type AngularImpulse = Real(final quantity = "AngularImpulse", final unit = "N.m.s");
      type MomentOfInertia = Real(final quantity = "MomentOfInertia", final unit = "kg.m2");
      type Inertia = Real(final quantity = "MomentOfInertia", final unit = "kg.m2");
      type Force = Real(final quantity = "Force", final unit = "N");
      type Weight = Real(final quantity = "Weight", final unit = "N");
      type TranslationalSpringConstant = Real(final quantity = "TranslationalSpringConstant", final unit = "N/m");
      type TranslationalDampingConstant = Real(final quantity = "TranslationalDampingConstant", final unit = "N.s/m");
      type Torque = Real(final quantity = "Torque", final unit = "N.m");
      type MomentOfForce = Real(final quantity = "MomentOfForce", final unit = "N.m");
      type RotationalSpringConstant = Real(final quantity = "RotationalSpringConstant", final unit = "N.m/rad");
      type RotationalDampingConstant = Real(final quantity = "RotationalDampingConstant", final unit = "N.m.s/rad");
      type ElectricalTorqueConstant = Real(final quantity = "ElectricalTorqueConstant", final unit = "N.m/A");
      type ElectricalForceConstant = Real(final quantity = "ElectricalForceConstant", final unit = "N/A");
      type Pressure = Real(final quantity = "Pressure", final unit = "Pa");
      type AbsolutePressure = Real(final quantity = "Pressure", final unit = "Pa", min = 0);
      type Stress = Real(final quantity = "Stress", final unit = "Pa");
      type Strain = Real(final quantity = "Strain", final unit = "1");
      type ModulusOfElasticity = Real(final quantity = "ModulusOfElasticity", final unit = "Pa");
      type ShearModulus = Real(final quantity = "ShearModulus", final unit = "Pa");
      type BulkModulus = Real(final quantity = "BulkModulus", final unit = "Pa");
      type DynamicViscosity = Real(final quantity = "DynamicViscosity", final unit = "Pa.s");
      type KinematicViscosity = Real(final quantity = "KinematicViscosity", final unit = "m2/s");
      type Work = Real(final quantity = "Work", final unit = "J");
      type Energy = Real(final quantity = "Energy", final unit = "J");
      type PotentialEnergy = Real(final quantity = "PotentialEnergy", final unit = "J");
      type KineticEnergy = Real(final quantity = "KineticEnergy", final unit = "J");
      type Power = Real(final quantity = "Power", final unit = "W");
      type EnergyFlowRate = Real(final quantity = "Power", final unit = "W");
      type Efficiency = Real(final quantity = "Efficiency", final unit = "1", min = 0);
      type MassFlowRate = Real(final quantity = "MassFlowRate", final unit = "kg/s");
      type VolumeFlowRate = Real(final quantity = "VolumeFlowRate", final unit = "m3/s");
      type ThermodynamicTemperature = Real(final quantity = "ThermodynamicTemperature", final unit = "K", min = 0, start = 288.15, nominal = 300, displayUnit = "degC");
      type Temperature = Real(final quantity = "ThermodynamicTemperature", final unit = "K", min = 0, start = 288.15, nominal = 300, displayUnit = "degC");
      type TemperatureDifference = Real(final quantity = "ThermodynamicTemperature", final unit = "K");
      type LinearTemperatureCoefficient = Real(final quantity = "LinearTemperatureCoefficient", final unit = "1/K");
      type LinearExpansionCoefficient = Real(final quantity = "LinearExpansionCoefficient", final unit = "1/K");
      type Heat = Real(final quantity = "Heat", final unit = "J");
      type HeatFlowRate = Real(final quantity = "Power", final unit = "W");
      type HeatFlux = Real(final quantity = "HeatFlux", final unit = "W/m2");
      type ThermalConductivity = Real(final quantity = "ThermalConductivity", final unit = "W/(m.K)");
      type CoefficientOfHeatTransfer = Real(final quantity = "CoefficientOfHeatTransfer", final unit = "W/(m2.K)");
      type ThermalResistance = Real(final quantity = "ThermalResistance", final unit = "K/W");
      type ThermalConductance = Real(final quantity = "ThermalConductance", final unit = "W/K");
      type HeatCapacity = Real(final quantity = "HeatCapacity", final unit = "J/K");
      type SpecificHeatCapacity = Real(final quantity = "SpecificHeatCapacity", final unit = "J/(kg.K)");
      type Entropy = Real(final quantity = "Entropy", final unit = "J/K");
      type SpecificEntropy = Real(final quantity = "SpecificEntropy", final unit = "J/(kg.K)");
      type InternalEnergy = Real(final quantity = "Heat", final unit = "J");
      type Enthalpy = Real(final quantity = "Heat", final unit = "J");
      type SpecificEnergy = Real(final quantity = "SpecificEnergy", final unit = "J/kg");
      type SpecificInternalEnergy = Real(final quantity = "SpecificEnergy", final unit = "J/kg");
      type SpecificEnthalpy = Real(final quantity = "SpecificEnergy", final unit = "J/kg");
      type ElectricCurrent = Real(final quantity = "ElectricCurrent", final unit = "A");
      type Current = Real(final quantity = "ElectricCurrent", final unit = "A");
      type ElectricCharge = Real(final quantity = "ElectricCharge", final unit = "C");
      type Charge = Real(final quantity = "ElectricCharge", final unit = "C");
      type ElectricPotential = Real(final quantity = "ElectricPotential", final unit = "V");
      type Voltage = Real(final quantity = "ElectricPotential", final unit = "V");
      type PotentialDifference = Real(final quantity = "ElectricPotential", final unit = "V");
      type ElectricFieldStrength = Real(final quantity = "ElectricFieldStrength", final unit = "V/m");
      type Capacitance = Real(final quantity = "Capacitance", final unit = "F");
      type Inductance = Real(final quantity = "Inductance", final unit = "H");
      type MutualInductance = Real(final quantity = "MutualInductance", final unit = "H");
      type Resistance = Real(final quantity = "Resistance", final unit = "Ohm");
      type Conductance = Real(final quantity = "Conductance", final unit = "S");
      type Resistivity = Real(final quantity = "Resistivity", final unit = "Ohm.m");
      type Conductivity = Real(final quantity = "Conductivity", final unit = "S/m");
      type Impedance = Real(final quantity = "Resistance", final unit = "Ohm");
      type Reactance = Real(final quantity = "Resistance", final unit = "Ohm");
      type Admittance = Real(final quantity = "Conductance", final unit = "S");
      type MagneticFlux = Real(final quantity = "MagneticFlux", final unit = "Wb");
      type MagneticFluxDensity = Real(final quantity = "MagneticFluxDensity", final unit = "T");
      type MagneticFieldStrength = Real(final quantity = "MagneticFieldStrength", final unit = "A/m");
      type Reluctance = Real(final quantity = "Reluctance", final unit = "H-1");
      type Permeance = Real(final quantity = "Permeance", final unit = "H");
      type Permeability = Real(final quantity = "Permeability", final unit = "H/m");
      type AmountOfSubstance = Real(final quantity = "AmountOfSubstance", final unit = "mol");
      type MolarMass = Real(final quantity = "MolarMass", final unit = "kg/mol");
      type Concentration = Real(final quantity = "AmountOfSubstanceConcentration", final unit = "mol/m3");
      type MassFraction = Real(final quantity = "MassFraction", final unit = "1", min = 0);
      type MoleFraction = Real(final quantity = "MoleFraction", final unit = "1", min = 0);
      type CoefficientOfFriction = Real(final quantity = "CoefficientOfFriction", final unit = "1");
      type ReynoldsNumber = Real(final quantity = "ReynoldsNumber", final unit = "1");
      type PerUnit = Real(final unit = "1");
      type DimensionlessRatio = Real(final unit = "1");
      type LossCoefficient = Real(final unit = "1");
    end SI;

    package NonSI
      type Temperature_degC = Real(final quantity = "ThermodynamicTemperature", final unit = "degC");
      type Angle_deg = Real(final quantity = "Angle", final unit = "deg");
      type AngularVelocity_rpm = Real(final quantity = "AngularVelocity", final unit = "rev/min");
    end NonSI;

    package Conversions
      function from_deg input Real degree(unit = "deg"); output SI.Angle radian; algorithm
        radian := Modelica.Constants.pi/180*degree; end from_deg;
      function to_deg input SI.Angle radian; output Real degree(unit = "deg"); algorithm
        degree := 180/Modelica.Constants.pi*radian; end to_deg;
      function from_rpm input Real rpm(unit = "rev/min"); output SI.AngularVelocity w; algorithm
        w := Modelica.Constants.pi/30*rpm; end from_rpm;
      function to_rpm input SI.AngularVelocity w; output Real rpm(unit = "rev/min"); algorithm
        rpm := 30/Modelica.Constants.pi*w; end to_rpm;
      function from_degC input Real Celsius(unit = "degC"); output SI.Temperature Kelvin; algorithm
        Kelvin := Celsius + 273.15; end from_degC;
      function to_degC input SI.Temperature Kelvin; output Real Celsius(unit = "degC"); algorithm
        Celsius := Kelvin - 273.15; end to_degC;
      function from_Hz input SI.Frequency f; output SI.AngularVelocity w; algorithm
        w := 2*Modelica.Constants.pi*f; end from_Hz;
      function to_Hz input SI.AngularVelocity w; output SI.Frequency f; algorithm
        f := w/(2*Modelica.Constants.pi); end to_Hz;
    end Conversions;
  end Units;

  package Constants
    final constant Real e = 2.718281828459045 "Euler's number";
    final constant Real pi = 3.141592653589793;
    final constant Real D2R = pi/180 "Degree to radian";
    final constant Real R2D = 180/pi "Radian to degree";
    final constant Real gamma = 0.5772156649015329 "Euler's constant";
    final constant Real eps = 2.220446049250313e-16 "Spacing of numbers at 1";
    final constant Real small = 1e-60;
    final constant Real inf = 1e60;
    final constant Integer Integer_inf = 2147483647;
    final constant Units.SI.Velocity c = 299792458 "Speed of light in vacuum";
    final constant Units.SI.Acceleration g_n = 9.80665 "Standard acceleration of free fall";
    final constant Real G(final unit = "m3/(kg.s2)") = 6.67430e-11 "Constant of gravitation";
    final constant Real h(final unit = "J.s") = 6.62607015e-34 "Planck constant";
    final constant Real k(final unit = "J/K") = 1.380649e-23 "Boltzmann constant";
    final constant Real N_A(final unit = "1/mol") = 6.02214076e23 "Avogadro constant";
    final constant Real R(final unit = "J/(mol.K)") = k*N_A "Molar gas constant";
    final constant Units.SI.ElectricCharge q = 1.602176634e-19 "Elementary charge";
    final constant Real F(final unit = "C/mol") = q*N_A "Faraday constant";
    final constant Real sigma(final unit = "W/(m2.K4)") = 2*pi^5*k^4/(15*h^3*c^2) "Stefan-Boltzmann constant";
    final constant Real mu_0(final unit = "N/A2") = 1.25663706212e-6 "Magnetic constant";
    final constant Real epsilon_0(final unit = "F/m") = 1/(mu_0*c*c) "Electric constant";
    final constant Real T_zero(final unit = "degC") = -273.15 "Absolute zero";
  end Constants;

  package Math
    function sin "Sine" input Real u; output Real y; external "builtin" y = sin(u); end sin;
    function cos "Cosine" input Real u; output Real y; external "builtin" y = cos(u); end cos;
    function tan "Tangent" input Real u; output Real y; external "builtin" y = tan(u); end tan;
    function asin "Inverse sine" input Real u; output Real y; external "builtin" y = asin(u); end asin;
    function acos "Inverse cosine" input Real u; output Real y; external "builtin" y = acos(u); end acos;
    function atan "Inverse tangent" input Real u; output Real y; external "builtin" y = atan(u); end atan;
    function sinh "Hyperbolic sine" input Real u; output Real y; external "builtin" y = sinh(u); end sinh;
    function cosh "Hyperbolic cosine" input Real u; output Real y; external "builtin" y = cosh(u); end cosh;
    function tanh "Hyperbolic tangent" input Real u; output Real y; external "builtin" y = tanh(u); end tanh;
    function exp "Exponential" input Real u; output Real y; external "builtin" y = exp(u); end exp;
    function log "Natural logarithm" input Real u; output Real y; external "builtin" y = log(u); end log;
    function log10 "Logarithm to base 10" input Real u; output Real y; external "builtin" y = log10(u); end log10;
    function atan2 "Inverse tangent in four quadrants"
      input Real u1; input Real u2; output Real y; external "builtin" y = atan2(u1, u2); end atan2;
    function isEqual "Whether two numbers are equal within eps"
      input Real s1; input Real s2; input Real eps = 0; output Boolean result; algorithm
      result := abs(s1 - s2) <= eps; end isEqual;
  end Math;

  package Icons "Without graphics"
    partial package Package end Package;
    partial package ExamplesPackage end ExamplesPackage;
    partial package InterfacesPackage end InterfacesPackage;
    partial package UtilitiesPackage end UtilitiesPackage;
    partial package TypesPackage end TypesPackage;
    partial package FunctionsPackage end FunctionsPackage;
    partial model Example end Example;
    partial class Information end Information;
    partial function Function end Function;
    partial record Record end Record;
  end Icons;

  package Blocks
    package Interfaces
      connector RealInput = input Real;
      connector RealOutput = output Real;
      connector BooleanInput = input Boolean;
      connector BooleanOutput = output Boolean;
      connector IntegerInput = input Integer;
      connector IntegerOutput = output Integer;
      partial block SO RealOutput y; end SO;
      partial block SISO RealInput u; RealOutput y; end SISO;
      partial block SI2SO RealInput u1; RealInput u2; RealOutput y; end SI2SO;
    end Interfaces;
  end Blocks;

  package Mechanics
    package Rotational
      package Interfaces
        connector Flange "Angle, and torque into the component" Units.SI.Angle phi; flow Units.SI.Torque tau; end Flange;
        connector Flange_a extends Flange; end Flange_a;
        connector Flange_b extends Flange; end Flange_b;
        connector Support extends Flange; end Support;
      end Interfaces;
    end Rotational;

    package Translational
      package Interfaces
        connector Flange "Position, and force into the component" Units.SI.Position s; flow Units.SI.Force f; end Flange;
        connector Flange_a extends Flange; end Flange_a;
        connector Flange_b extends Flange; end Flange_b;
        connector Support extends Flange; end Support;
      end Interfaces;
    end Translational;
  end Mechanics;

  package Electrical
    package Analog
      package Interfaces
        connector Pin "Potential, and current into the component"
          Units.SI.ElectricPotential v; flow Units.SI.Current i; end Pin;
        connector PositivePin extends Pin; end PositivePin;
        connector NegativePin extends Pin; end NegativePin;
      end Interfaces;
    end Analog;
  end Electrical;

  package Thermal
    package HeatTransfer
      package Interfaces
        connector HeatPort "Temperature, and heat flow into the component"
          Units.SI.Temperature T; flow Units.SI.HeatFlowRate Q_flow; end HeatPort;
        connector HeatPort_a extends HeatPort; end HeatPort_a;
        connector HeatPort_b extends HeatPort; end HeatPort_b;
      end Interfaces;
    end HeatTransfer;
  end Thermal;
end Modelica;
