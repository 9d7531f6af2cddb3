"""Diagnoses of rigs whose models are FMUs without source, written by hand in C."""
