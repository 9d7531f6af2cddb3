"""A drive and its logs, to see what fmuid does before there is a model and a log of one's own."""
