from tests.cli.conftest import measurements, oscillator

__all__ = ["measurements", "oscillator"]
