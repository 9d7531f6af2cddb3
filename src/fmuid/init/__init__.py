"""`fmuid init`: a first campaign from logs and a model."""
