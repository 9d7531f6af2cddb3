"""Reports of a run: one HTML page that opens offline, with figures and their data beside it."""
