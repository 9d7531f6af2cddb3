"""Discovery of laws: an equation in a model's own quantities for a gap that no effect explains."""
