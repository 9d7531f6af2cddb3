"""Rigs other than actuators: plain models, and plants in independent code that lack one of six effects each."""
