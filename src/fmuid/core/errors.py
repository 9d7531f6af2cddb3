"""Errors of fmuid: each says in one line what is wrong, where, and what to do."""

from __future__ import annotations

from fmu_build.errors import UserError


class FmuidError(UserError):
    """Base class of the errors that fmuid raises; `fmu_build` has its own."""


class CampaignError(FmuidError):
    """``campaign.toml`` is malformed or refers to something that does not exist."""


class MeasurementsError(FmuidError):
    """A measurement file violates the format."""


class UnitError(FmuidError):
    """Two units cannot be converted into each other, or a unit is unknown."""


class FmuError(FmuidError):
    """An FMU cannot be read, lacks a variable, or refuses a value."""


class SimulationError(FmuidError):
    """A simulation failed, so there is no prediction at these parameter values."""


class ProblemError(FmuidError):
    """The identification problem is ill-posed or contradictory."""
