"""Parts of a coupled system: connections, ports and the settings of its master. Values only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

from fmuid.core.immutable import frozen_mapping

Algorithm = Literal["jacobi", "gauss_seidel"]
Extrapolation = Literal["constant", "linear"]
Loops = Literal["refuse", "delay", "iterate"]


class Place(NamedTuple):
    """A variable of a component."""

    component: str
    variable: str

    def __str__(self) -> str:
        return f"{self.component}.{self.variable}"


class Linear(NamedTuple):
    """``target = factor * source + offset``."""

    factor: float = 1.0
    offset: float = 0.0

    def then(self, other: Linear) -> Linear:
        """Return the transformation that applies this one, then the other."""
        return Linear(other.factor * self.factor, other.factor * self.offset + other.offset)

    def __call__(self, value: float) -> float:
        """Return the converted value."""
        return self.factor * value + self.offset


@dataclass(frozen=True, slots=True)
class Connection:
    """An input connected to an output of a component."""

    source: Place
    target: Place
    linear: Linear = field(default_factory=Linear)


@dataclass(frozen=True, slots=True)
class Port:
    """A variable of the system itself: an input or a parameter that sets variables of components, or an output.

    Parameters
    ----------
    ends
        Component variables with the transformation from the port to each; for an output, the variable it shows,
        with the transformation from that variable.
    """

    name: str
    causality: Literal["input", "parameter", "output"]
    unit: str | None
    ends: tuple[tuple[Place, Linear], ...]


@dataclass(frozen=True, slots=True)
class Master:
    """Options for stepping coupled FMUs together.

    Parameters
    ----------
    step
        Largest communication step, s; None for one step between two samples of the task.
    algorithm
        ``jacobi``: every input is extrapolated over the step. ``gauss_seidel``: an input is interpolated if its
        source FMU has already taken the step.
    extrapolation
        ``constant``: the last value is held; ``linear``: the line through the last two values is continued. One
        for all components, or by component; a component that is not named uses ``constant``.
    loops
        What to do about algebraic loops: ``refuse`` them, ``delay`` them by the communication step, or ``iterate``
        every step until inputs and outputs agree.
    loop_tolerance
        Relative disagreement between inputs and outputs at which the iteration ends.
    loop_iterations
        Number of iterations after which the step fails.
    """

    step: float | None = None
    algorithm: Algorithm = "gauss_seidel"
    extrapolation: Extrapolation | Mapping[str, Extrapolation] = "constant"
    loops: Loops = "refuse"
    loop_tolerance: float = 1e-6
    loop_iterations: int = 50

    def __post_init__(self) -> None:
        if not isinstance(self.extrapolation, str):
            object.__setattr__(self, "extrapolation", frozen_mapping(self.extrapolation))

    def extrapolates(self, component: str) -> bool:
        """Return whether the inputs of a component are extrapolated linearly."""
        if isinstance(self.extrapolation, str):
            return self.extrapolation == "linear"
        return self.extrapolation.get(component) == "linear"


@dataclass(frozen=True, slots=True)
class Coupling:
    """The coupling of FMUs that a campaign specifies.

    Parameters
    ----------
    components
        FMU files by name; empty for an SSP file, which has its own.
    connections
        Input -> the output it follows, and the transformation between them; keys are ``component.variable``.
    main
        The component whose variables are named without its name as a prefix; empty for none.
    """

    master: Master = field(default_factory=Master)
    components: Mapping[str, Path] = field(default_factory=dict)
    connections: Mapping[str, tuple[str, Linear]] = field(default_factory=dict)
    main: str = ""

    def __post_init__(self) -> None:
        for name in ("components", "connections"):
            object.__setattr__(self, name, frozen_mapping(getattr(self, name)))
