"""Several FMUs coupled by their inputs and outputs: one model to everyone else."""
