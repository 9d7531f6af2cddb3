"""Design of experiments within the limits of a rig: excitations, their search, and their information."""
