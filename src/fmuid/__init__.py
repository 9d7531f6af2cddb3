"""Identify the parameters of FMUs from measurement campaigns, and diagnose what the model misses."""
