"""Experiments designed within the limits of a rig: excitations, the search among them, and what they tell."""
