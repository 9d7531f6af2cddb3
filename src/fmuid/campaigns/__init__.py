"""Campaign files: reading and checking."""
