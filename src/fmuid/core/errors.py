"""Errors of fmuid: each says in one line what is wrong, where, and what to do."""

from __future__ import annotations

import re
from contextvars import ContextVar
from functools import partial

AT_A_SHELL: ContextVar[bool] = ContextVar("AT_A_SHELL", default=False)
"""Whether messages are for somebody who types commands, so that they name options, as in ``--root``."""

_OPTION = re.compile(r"(?<![\w-])--([a-z][a-z-]*)(?: (?=['\"A-Z]))?")
_ARGUMENTS = {
    "align": "base.align=",
    "experiment": "experiments=",
    "for": "purpose=",
    "from": "start=",
    "resample": "base.rate=",
    "resume": "resume=True",
    "root": "roots=",
    "sigma": "sigmas=",
    "signal": "signals=",
    "stage": "stages=",
    "trust": "trust=True",
    "unit": "units=",
}


def in_python(text: str) -> str:
    """Return a message with Python arguments, such as ``roots=``, in place of command-line options."""
    return _OPTION.sub(lambda m: _ARGUMENTS.get(m[1], m[1].replace("-", "_") + "="), text)


class FmuidError(Exception):
    """Base class of the errors that fmuid raises on purpose; prints as one line. `fmu_build` has its own.

    Parameters
    ----------
    what
        What is wrong, in the user's words.
    where
        The file, table, experiment or variable concerned.
    fix
        What the user can do about it.
    """

    def __init__(self, what: str, *, where: object = None, fix: str | None = None) -> None:
        self.what = what
        self.where = None if where is None else str(where)
        self.fix = fix
        place = "" if self.where is None else f"{self.where}: "
        super().__init__(" ".join(f"{place}{what}{'' if fix is None else f'; {fix}'}".split()))

    def __str__(self) -> str:
        text = super().__str__()
        return text if AT_A_SHELL.get() else in_python(text)

    def __reduce__(self) -> tuple[object, ...]:
        # Errors are sent between processes; keyword arguments need this to be pickled.
        return (partial(type(self), where=self.where, fix=self.fix), (self.what,))


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
