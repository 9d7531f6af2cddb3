"""Differences between machines: spread of per-machine parameters, and prediction for the next machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fmuid.core.formatting import interval_text

LEVEL = 0.95
_DIFFERENT = 0.05


@dataclass(frozen=True, slots=True)
class MachineSpread:
    """One parameter over several machines: a random-effects summary (DerSimonian and Laird, 1986).

    Parameters
    ----------
    name
        The parameter.
    machines
        The machines' names.
    mean, spread
        Mean over all machines of the kind, and standard deviation between them beyond the errors of the estimates.
    p_value
        p-value that all machines have the same value: Welch's test (1951), which is Cochran's if errors are known.
    next_machine
        95 % prediction interval of the next machine's value (Higgins and others, 2009); None for two machines.
    """

    name: str
    machines: tuple[str, ...]
    mean: float
    spread: float
    p_value: float
    next_machine: tuple[float, float] | None

    @property
    def differs(self) -> bool:
        """Whether machines differ by more than the uncertainty of their estimates."""
        return self.p_value < _DIFFERENT

    def __str__(self) -> str:
        """Return the summary in one line."""
        verdict = (
            "differs between machines" if self.differs else "is the same on all machines within its uncertainty"
        )
        text = f"{self.name} {verdict} (p = {self.p_value:.2g}): mean {self.mean:.4g}, spread {self.spread:.2g}"
        if self.next_machine is None:
            return text
        return f"{text}; next machine, 95 %: {interval_text(*self.next_machine)}"


def machine_spread(
    name: str,
    machines: Sequence[str],
    values: Sequence[float],
    errors: Sequence[float],
    degrees: Sequence[float] | None = None,
) -> MachineSpread:
    """Return the summary of one parameter's estimates on several machines.

    Parameters
    ----------
    name
        The parameter.
    machines, values, errors
        (k,) names, estimates and standard errors; at least two.
    degrees
        (k,) degrees of freedom of the standard errors; infinite by default.
    """
    from scipy.stats import chi2, f, t

    y, variance = np.array(values), np.square(errors)
    k, w = len(y), 1.0 / variance
    fixed = float(w @ y / w.sum())
    q = float(w @ (y - fixed) ** 2)
    doubt = float(np.sum((1.0 - w / w.sum()) ** 2 / np.maximum(np.inf if degrees is None else degrees, 1.0)))
    if doubt > 0.0:
        ratio = q / (k - 1) / (1.0 + 2.0 * (k - 2) / (k**2 - 1) * doubt)
        p_value = float(f.sf(ratio, k - 1, (k**2 - 1) / (3.0 * doubt)))
    else:
        p_value = float(chi2.sf(q, k - 1))
    between = max(0.0, (q - (k - 1)) / float(w.sum() - (w @ w) / w.sum()))
    w = 1.0 / (variance + between)
    mean, error = float(w @ y / w.sum()), float(1.0 / w.sum())
    interval = None
    if k > 2:
        half = float(t.ppf(0.5 + 0.5 * LEVEL, k - 2) * np.sqrt(between + error))
        interval = (mean - half, mean + half)
    return MachineSpread(name, tuple(machines), mean, float(np.sqrt(between)), p_value, interval)
