"""Front end: Modelica source to a flat model (`flatten.load`)."""
