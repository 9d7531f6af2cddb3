"""FMUs coupled through their inputs and outputs, used like a single model."""
