"""Measurements: files and noise."""
