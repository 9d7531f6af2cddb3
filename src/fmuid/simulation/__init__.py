"""Simulation of FMUs, single or coupled, in this process or in workers."""
