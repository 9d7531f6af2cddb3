"""The errors of fmuid: what is wrong, where, and what to do, in one line."""

from __future__ import annotations

from fmu_build.errors import UserError


class FmuidError(UserError):
    """Base of every error that fmuid raises on purpose; `fmu_build` has its own."""


class CampaignError(FmuidError):
    """``campaign.toml`` is malformed or names what does not exist."""


class MeasurementsError(FmuidError):
    """A measurement file breaks the format's rules."""


class UnitError(FmuidError):
    """Two units cannot be converted into each other, or a unit is unknown."""


class FmuError(FmuidError):
    """An FMU cannot be read, lacks a variable, or refuses a value."""


class SimulationError(FmuidError):
    """One simulation failed; the parameter point has no prediction."""


class ProblemError(FmuidError):
    """An identification problem that cannot be posed as given."""
