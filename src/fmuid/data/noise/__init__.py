"""The noise of measurements: its level, its spectrum, its resolution, and samples that are none."""
