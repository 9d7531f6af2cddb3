"""Measurements: their files, and the noise in them."""
