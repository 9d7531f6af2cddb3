"""The local page: prepare a campaign, follow and steer its identification, look at the result."""
