"""From a stage to numbers: cases, criteria, one cost, and its derivatives."""
