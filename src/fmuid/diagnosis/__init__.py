"""Where simulation and measurement part, which effect is why, and how much of the gap it closes."""
