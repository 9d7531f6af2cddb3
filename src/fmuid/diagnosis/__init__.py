"""Diagnosis of the gap between simulation and measurement: its place, its cause, and its reduction."""
