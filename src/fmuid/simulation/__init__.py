"""What simulates: any FMU, in compiled code or in Python."""
