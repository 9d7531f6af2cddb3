"""From Modelica source to a tested FMU with packages from PyPI and a C compiler."""
