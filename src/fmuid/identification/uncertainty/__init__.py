"""Uncertainty of results: covariances, intervals, identifiability."""
