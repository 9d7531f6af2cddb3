"""Value types that every other package uses, and helpers for files, units and messages."""
