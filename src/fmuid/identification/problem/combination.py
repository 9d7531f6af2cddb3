"""Combination of criteria into one cost, and constraints."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmuid.core.errors import ProblemError
from fmuid.core.formulas import Expression, parse
from fmuid.core.immutable import FloatArray

KINDS = ("weighted_sum", "min_max", "p_norm", "lexicographic")


@dataclass(frozen=True, slots=True)
class Combination:
    """How criteria are combined into one cost.

    - ``weighted_sum``: sum of weight * residual^2 over all residuals; with least squares on known noise this
      is twice the negative log likelihood.
    - ``min_max``: the largest weight * value. Solvers that take constraints get the smooth epigraph form:
      minimise t subject to weight * value <= t.
    - ``p_norm`` or ``p_norm(8)``: (sum (weight * value)^p)^(1/p), between the two; p = 8 by default.
    - ``lexicographic``: by the criteria's option `priority` (1 first): while later groups are minimised, earlier
      criteria may worsen up to their demands, or up to their best values if those are larger.
    """

    kind: str = "weighted_sum"
    p: float = 8.0

    @classmethod
    def named(cls, text: str, *, where: str | None = None) -> Combination:
        """Return the combination named in a campaign."""
        match = re.fullmatch(r"(\w+?)(?:\((\d+(?:\.\d+)?)\))?", text.replace(" ", ""))
        if match is None or match[1] not in KINDS or (match[2] and match[1] != "p_norm"):
            raise ProblemError(f"unknown combine '{text}'", where=where, fix=f"use one of {', '.join(KINDS)}")
        p = float(match[2] or 8.0)
        if p < 1.0:
            raise ProblemError(f"p = {p:g} is below 1", where=where, fix="use 1 or more")
        return cls(match[1], p)

    def cost(self, criteria: FloatArray, residuals: FloatArray, weights: FloatArray) -> float:
        """Return the cost of (n,) criteria `values`, (m,) weighted residuals and (n,) weights."""
        match self.kind:
            case "min_max":
                return float(np.max(weights * criteria))
            case "p_norm":
                scaled = weights * criteria
                largest = float(np.max(scaled))
                if largest == 0.0:
                    return 0.0
                return float(largest * np.sum((scaled / largest) ** self.p) ** (1.0 / self.p))
        return float(np.sum(np.square(residuals)))  # a BLAS dot product would start threads


@dataclass(frozen=True, slots=True)
class Constraint:
    """A limit on an ``expression`` of parameters or on a ``criterion``: at most, at least or equal to a value.

    Parameters
    ----------
    expression
        Arithmetic on parameters in model space, or None.
    criterion
        Label of a criterion (globs allowed; the worst one counts), or None.
    """

    text: str
    expression: Expression | None = None
    criterion: str | None = None
    minimum: float | None = None
    maximum: float | None = None
    equal: float | None = None

    @classmethod
    def from_mapping(cls, table: Mapping[str, Any], *, where: str | None = None) -> Constraint:
        """Read ``{ expression = "a - b", max = 0.0 }`` or ``{ criterion = "tau maximum", max = 1.0 }``."""
        table = dict(table)
        expression, criterion = table.pop("expression", None), table.pop("criterion", None)
        limits = {key: table.pop(key) for key in ("min", "max", "equal") if key in table}
        text = str(expression or criterion)
        if table or len(limits) != 1 or (expression is None) == (criterion is None):
            raise ProblemError(
                f"constraint on '{text}' is not understood",
                where=where,
                fix='write { expression = "a - b", max = 0.0 }; or criterion = "...", and min or equal',
            )
        for key, limit in limits.items():
            if isinstance(limit, bool) or not isinstance(limit, int | float):
                raise ProblemError(f"{key} of '{text}' is {limit!r}", where=where, fix="write a number")
        return cls(
            text,
            parse(str(expression), where=where) if expression is not None else None,
            criterion,
            limits.get("min"),
            limits.get("max"),
            limits.get("equal"),
        )

    @property
    def is_equality(self) -> bool:
        """Whether it is an equality constraint."""
        return self.equal is not None

    def check(self, labels: Sequence[str], parameters: Mapping[str, float], *, where: str | None = None) -> None:
        """Raise ProblemError if it refers to an unknown parameter or criterion."""
        if self.expression is not None:
            if missing := sorted(self.expression.names - set(parameters)):
                raise ProblemError(
                    f"constraint '{self.text}' names unknown parameter '{missing[0]}'",
                    where=where,
                    fix=f"known: {', '.join(parameters)}",
                )
        elif not matching(labels, self.criterion or ""):
            raise ProblemError(
                f"no criterion matches '{self.text}'", where=where, fix=f"there are: {', '.join(labels)}"
            )

    def violation(self, labels: Sequence[str], criteria: FloatArray, parameters: Mapping[str, float]) -> float:
        """Return the violation: at most 0 (inequality) or exactly 0 (equality) if satisfied."""
        if self.expression is not None:
            number = self.expression(parameters)
        else:
            number = float(np.max(criteria[matching(labels, self.criterion or "")]))
        if self.maximum is not None:
            return number - self.maximum
        if self.minimum is not None:
            return self.minimum - number
        return number - float(self.equal or 0.0)


def matching(labels: Sequence[str], pattern: str) -> list[int]:
    """Return the criteria labels (``case: name``) that match a glob, with or without the case."""
    return [
        i
        for i, label in enumerate(labels)
        if fnmatch.fnmatchcase(label, pattern) or fnmatch.fnmatchcase(label.partition(": ")[2], pattern)
    ]
