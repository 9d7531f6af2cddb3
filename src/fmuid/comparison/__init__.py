"""Simulations against references: a result against a table, and a model against its own past."""
