model Ishigami "Test function of sensitivity analysis: Ishigami and Homma, 1990"
  parameter Real a = 1;
  parameter Real b = 1;
  parameter Real c = 1;
  parameter Real idle = 1;
  output Real y = sin(a) + 7*sin(b)^2 + 0.1*c^4*sin(a);
  output Real still = time;
annotation(Documentation(info = "Nothing depends on idle, and still depends on nothing."));
end Ishigami;
