"""The numerical problem of a stage: cases, criteria, the cost and its derivatives."""
