"""Errors that a user can act on: what is wrong, where, and what to do."""

from __future__ import annotations

from functools import partial


def counted(number: int, noun: str) -> str:
    """Return ``1 run``, ``2 runs`` and so on."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


class UserError(Exception):
    """Base of every error that is raised on purpose; prints as one line.

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

    def __reduce__(self) -> tuple[object, ...]:
        # Errors are sent between processes; keyword arguments need this to be pickled.
        return (partial(type(self), where=self.where, fix=self.fix), (self.what,))


class ModelicaError(UserError):
    """Modelica source that is wrong or outside the supported subset."""


class IndexOutsideError(ModelicaError):
    """A subscript outside its array."""


class InputDerivativeError(ModelicaError):
    """Equations need the derivative of an input, which an FMU is not given; `input` is its name."""

    def __init__(self, input: str, *, where: object) -> None:
        self.input = input
        fix = "put a filter or an integrator between the input and its differentiation"
        super().__init__(f"the derivative of input '{input}' is needed", where=where, fix=fix)

    def __reduce__(self) -> tuple[object, ...]:
        return (partial(type(self), where=self.where), (self.input,))


class BuildError(UserError):
    """The C compiler or the packaging of an FMU failed."""
