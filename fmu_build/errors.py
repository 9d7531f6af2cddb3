"""Errors that a user can act on: what is wrong, where, and what to do."""

from __future__ import annotations


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
        line = what if self.where is None else f"{self.where}: {what}"
        if fix is not None:
            line = f"{line}; {fix}"
        super().__init__(" ".join(line.split()))

    def __reduce__(self) -> tuple[object, ...]:
        # Errors are sent between processes; keyword arguments need this to be pickled.
        return (_rebuild, (type(self), self.what, self.where, self.fix))


def _rebuild(kind: type[UserError], what: str, where: str | None, fix: str | None) -> UserError:
    return kind(what, where=where, fix=fix)


class ModelicaError(UserError):
    """Modelica source that is wrong or outside the supported subset."""


class IndexOutsideError(ModelicaError):
    """A subscript outside its array."""


class BuildError(UserError):
    """The C compiler or the packaging of an FMU failed."""
