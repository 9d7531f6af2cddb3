"""Plots of values that know nothing of plotting: drawn by `fmuid.report` when they are asked for."""

from __future__ import annotations

from importlib import import_module
from typing import Any


class Plottable:
    """Base of values with a `plot` method."""

    __slots__ = ()

    def plot(self, kind: str | None = None) -> Any:
        """Return a Matplotlib figure.

        Parameters
        ----------
        kind
            For a campaign ``measurements``; for a result ``parameters``, ``correlation``, ``starts``, ``profile``
            or ``overlay`` (which simulates the runs); for a validation ``overlay`` or ``errors``; for a diagnosis
            ``gap``, ``effects`` or ``law``. The default is the first that there is.

        Raises
        ------
        FmuidError
            There is no such plot of this value.
        """
        return import_module("fmuid.report.python_plots").plot(self, kind)
