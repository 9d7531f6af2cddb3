"""Values that every other package speaks of, and what files, units and messages need."""
