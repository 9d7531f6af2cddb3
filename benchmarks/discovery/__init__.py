"""Laws that no catalogue has: whether a diagnosis finds their equation, and keeps silent where there is none."""
