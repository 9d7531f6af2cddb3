from tests.cli.conftest import folder, measurements, oscillator

__all__ = ["folder", "measurements", "oscillator"]
