"""From a campaign to the parameters that fit it best, and how far to trust them."""
