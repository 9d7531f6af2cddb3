"""Rigs that are no actuator: plain models, and plants in independent code that lack one of six effects each."""
