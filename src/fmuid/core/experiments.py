"""Measured data: signals, runs, and the runs of one file. Values only; files are read elsewhere."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from fmuid.core.errors import MeasurementsError
from fmuid.core.formatting import html_table, text_table
from fmuid.core.immutable import FloatArray, frozen_mapping, read_only

if TYPE_CHECKING:
    from fmuid.core.frames import Library

Causality = Literal["input", "output"]
SAME_TIMES = 0.1  # sampling intervals: jitter as small as that of rounded times does not count
NEAR_TIMES = 0.5  # with more jitter than this, samples are no longer counterparts


def widened(courses: Sequence[FloatArray], share: float = 0.0) -> tuple[float, float]:
    """Return the least and the largest of recorded values, with a `share` of their range beyond each."""
    low, high = (float(of([of(c) for c in courses])) for of in (np.nanmin, np.nanmax))
    return low - share * (high - low), high + share * (high - low)


@dataclass(frozen=True, slots=True, eq=False)
class Signal:
    """One recorded signal.

    Parameters
    ----------
    name
        Measured name, such as ``tau_sensor``.
    values
        (N,) samples; NaN marks a missing output sample.
    unit
        Unit as written in the file, such as ``N.m``.
    causality
        ``input`` drives the model, ``output`` is compared with it.
    sigma
        Standard deviation of the measurement noise in `unit`, if known.
    resampled
        The original time base and the resampling method; empty if the samples are as recorded.
    """

    name: str
    values: FloatArray = field(repr=False)
    unit: str
    causality: Causality
    sigma: float | None = None
    resampled: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", read_only(self.values))


@dataclass(frozen=True, slots=True, eq=False)
class Experiment:
    """One recorded run.

    Parameters
    ----------
    id
        Name of the run in the measurement file.
    setup
        Name of the setup, which selects the model.
    time
        (N,) in s, strictly increasing.
    signals
        Inputs and outputs by name, (N,) each.
    settings, setting_units
        Known values that the run sets on the model, by name, and their units (the model's units by default).
    repeat_of
        Id of the first run with the same inputs, settings and times (its clock may have begun elsewhere); None if
        this run is not a repeat.
    description
        Text for reports.
    machine
        The machine that was measured.
    repeat_of_reference
        Id of the first run with the same reference, settings and times, whose recorded inputs differ from this
        run's by no more than noise or the reaction of a controller; None if there is none.
    unused
        Logged columns that the model does not use, by name: a coefficient may turn out to depend on one.
    """

    id: str
    setup: str
    time: FloatArray = field(repr=False)
    signals: Mapping[str, Signal]
    settings: Mapping[str, float] = field(default_factory=dict)
    setting_units: Mapping[str, str] = field(default_factory=dict)
    repeat_of: str | None = None
    description: str = ""
    machine: str = ""
    repeat_of_reference: str | None = None
    unused: Mapping[str, Signal] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "time", read_only(self.time))
        for name in ("signals", "settings", "setting_units", "unused"):
            object.__setattr__(self, name, frozen_mapping(getattr(self, name)))

    @property
    def inputs(self) -> Mapping[str, Signal]:
        """The signals that drive the model, by measured name."""
        return {name: s for name, s in self.signals.items() if s.causality == "input"}

    @property
    def outputs(self) -> Mapping[str, Signal]:
        """The signals that are compared with predictions, by measured name."""
        return {name: s for name, s in self.signals.items() if s.causality == "output"}

    @property
    def origin(self) -> str:
        """Id of the run this one repeats, or its own."""
        return self.repeat_of or self.id

    def sampled_like(self, other: Experiment, *, within: float = SAME_TIMES) -> bool:
        """Return whether the samples of another run are at the same times after its start.

        Their clocks may begin at any time, and their times may differ `within` a share of the sampling interval.
        """
        if self.time.size != other.time.size:
            return False
        apart = self.time - other.time
        return bool(np.ptp(apart) <= within * np.median(np.diff(self.time)))

    @property
    def repeats_another(self) -> bool:
        """Whether this run repeats another, with the same inputs or the same reference."""
        return self.repeat_of is not None or self.repeat_of_reference is not None

    def to_frame(self, library: Library = "pandas") -> Any:
        """Return times and signals as a data frame, columns with units: ``tau [N.m]``; see `fmuid.start`."""
        from fmuid.core.frames import to_frame

        signals = {f"{name} [{s.unit}]": s.values for name, s in self.signals.items()}
        return to_frame({"time [s]": self.time, **signals}, library)

    @property
    def digest(self) -> str:
        """Hash of the times, samples and settings; it does not depend on the id."""
        digest = hashlib.sha256(self.time.tobytes())
        for name, signal in sorted((*self.signals.items(), *self.unused.items())):
            digest.update(f"{name} {signal.causality} [{signal.unit}]".encode() + signal.values.tobytes())
        digest.update(repr(sorted(self.settings.items())).encode())
        return digest.hexdigest()


OutlierKind = Literal["spike", "held"]


@dataclass(frozen=True, slots=True)
class Outliers:
    """Samples of one signal of one run that are excluded as outliers.

    Parameters
    ----------
    kind
        ``spike`` or ``held``.
    times
        Times of the samples, s.
    """

    experiment: str
    signal: str
    kind: OutlierKind
    times: tuple[float, ...]

    def __str__(self) -> str:
        """Return a description of the samples and their times."""
        shown = ", ".join(f"{t:.6g}" for t in self.times[:4]) + (", ..." if len(self.times) > 4 else "")
        samples = "sample" if len(self.times) == 1 else "samples"
        kind = "spiked" if self.kind == "spike" else "held"
        return f"{len(self.times)} {kind} {samples} (at {shown} s)"


@dataclass(frozen=True, slots=True, eq=False)
class Measurements:
    """The experiments of one measurement file; prints as a table.

    Parameters
    ----------
    experiments
        By id, in the file's order.
    title, rig, source, licence
        Free text about the recording.
    history
        The commands that made the file, one per line.
    """

    experiments: Mapping[str, Experiment]
    title: str = ""
    rig: str = ""
    source: str = ""
    licence: str = ""
    history: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "experiments", frozen_mapping(self.experiments))

    def __getitem__(self, experiment_id: str) -> Experiment:
        try:
            return self.experiments[experiment_id]
        except KeyError:
            known = ", ".join(self.experiments) or "none"
            raise MeasurementsError(f"no experiment '{experiment_id}'", fix=f"the file has: {known}") from None

    def __iter__(self) -> Iterator[Experiment]:
        return iter(self.experiments.values())

    def __len__(self) -> int:
        return len(self.experiments)

    def __str__(self) -> str:
        """Return the runs as a table."""
        return text_table(self._rows())

    def _repr_html_(self) -> str:
        return html_table(self._rows())

    def _rows(self) -> list[list[str]]:
        header = ["experiment", "setup", "samples", "end", "inputs", "outputs", "repeat of"]
        return [
            header,
            *(
                [
                    e.id,
                    e.setup,
                    str(e.time.size),
                    f"{e.time[-1]:.6g} s",
                    ", ".join(f"{s.name} [{s.unit}]" for s in e.inputs.values()),
                    ", ".join(f"{s.name} [{s.unit}]" for s in e.outputs.values()),
                    e.repeat_of or e.repeat_of_reference or "",
                ]
                for e in self
            ),
        ]

    def repeats(self, experiment_id: str) -> tuple[Experiment, ...]:
        """Return every run with the same origin as `experiment_id`, itself included."""
        origin = self[experiment_id].origin
        return tuple(e for e in self if e.origin == origin)
