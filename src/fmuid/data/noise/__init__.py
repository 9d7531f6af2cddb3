"""Measurement noise: its level, spectrum and resolution, and outliers."""
