"""From "unknown" to an equation: a law of a model's own quantities, found where a diagnosis names no effect."""
