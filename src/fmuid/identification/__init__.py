"""From a campaign to the parameters that fit it best, with their uncertainty."""
