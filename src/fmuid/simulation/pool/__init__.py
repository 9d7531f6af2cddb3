"""Execution of simulations: in this process, in supervised workers, or on a cluster."""
