"""A drive and its logs, for a demonstration without a model and logs of your own."""
