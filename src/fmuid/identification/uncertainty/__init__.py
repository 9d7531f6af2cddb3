"""How far results can be trusted: covariances, intervals, identifiability."""
