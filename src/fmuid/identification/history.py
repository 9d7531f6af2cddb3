"""Every evaluation of an identification, kept on disk and safe against a kill at any moment.

While a run goes on, each evaluation is one record at the end of ``history.journal``: length, checksum,
content. A kill can only cut the last record short, and reading stops there. When the run ends (Ctrl-C
included) its content is written to ``history.h5`` in one atomic step; once it is complete the journal goes. An
interrupted run is resumed by running it again: solvers are deterministic, and what the journal knows is not
simulated a second time, so the run goes on exactly where it stopped.

``history.h5``, version 1: root attributes ``format = "fmuid-history"``, ``version``. For each stage a group
``/stages/<name>`` with attributes ``parameters`` (names of the columns), ``criteria`` (labels), ``cases``,
``signals`` and datasets with one row an evaluation:

================  ==================  ===================================================================
``parameters``    (n, n_parameters)   model space
``search``        (n, n_free)         search space
``criteria``      (n, n_criteria)     over their demands; NaN if failed
``constraints``   (n, n_constraints)
``cost``          (n,)                NaN if failed
``failure``       (n,)                text, empty if it did not fail
``purpose``       (n,)                search, derivative, uncertainty (which moves what is held, too) or pareto
``seconds``       (n,)                wall time
``improved``      (n,)                whether it was the best so far
================  ==================  ===================================================================

and ``iterates/<row>/<case>``, (signals, N): the predictions of each row that improved.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import msgspec
import numpy as np

from fmuid.core.errors import FmuidError, MeasurementsError
from fmuid.core.files import make_folder
from fmuid.core.immutable import FloatArray, read_only
from fmuid.data import hdf5
from fmuid.data.isolated_reader import read_apart
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation

JOURNAL, FILE = "history.journal", "history.h5"
FORMAT, VERSION = "fmuid-history", 1
_MAGIC = b"fmuid-journal 1\n"
_HEAD = struct.Struct("<II")  # length and CRC-32 of the content
_LARGEST_RECORD = 1 << 30


class HistoryError(FmuidError):
    """A history cannot be read, or belongs to another problem."""


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """One recorded evaluation."""

    search: FloatArray
    parameters: Mapping[str, float]
    criteria: FloatArray
    constraints: FloatArray
    cost: float
    failure: str | None
    purpose: str
    seconds: float
    improved: bool
    residuals: FloatArray | None = None
    predictions: tuple[FloatArray, ...] = ()

    def evaluation(self) -> Evaluation:
        """Return it as the evaluation it was."""
        residuals = np.zeros(0) if self.residuals is None else self.residuals
        return Evaluation(
            self.search,
            self.parameters,
            self.criteria,
            residuals,
            self.cost,
            self.constraints,
            self.failure,
            self.seconds,
            self.predictions,
        )


@dataclass(slots=True, eq=False)
class StageHistory:
    """The evaluations of one stage, in their order."""

    name: str
    fingerprint: str
    parameters: tuple[str, ...]
    criteria: tuple[str, ...]
    cases: tuple[str, ...]
    signals: tuple[tuple[str, ...], ...]
    rows: list[Row] = field(default_factory=list)
    result: bytes | None = None
    asked: str = ""  # what was to be found about the result

    @property
    def costs(self) -> FloatArray:
        """(n,) costs."""
        return read_only([row.cost for row in self.rows])

    def iterates(self) -> Iterator[tuple[int, Row]]:
        """Return the rows that improved, with their numbers."""
        return ((i, row) for i, row in enumerate(self.rows) if row.improved)


class History:
    """The history of one run folder, open for appending.

    Parameters
    ----------
    folder
        The run folder, or None to keep the history in memory.
    resume
        Take up the journal of an interrupted run; without it an old history is replaced.
    """

    def __init__(self, folder: Path | None, *, resume: bool = False) -> None:
        self.folder = folder
        self.stages: dict[str, StageHistory] = {}
        self._known: dict[str, dict[bytes, Row]] = {}
        self._journal: BinaryIO | None = None
        if folder is None:
            return
        make_folder(folder)
        path = folder / JOURNAL
        end = len(_MAGIC)
        if resume and path.exists():
            for record, end in _records(path):  # noqa: B007 - the last end counts
                self._take(record)
        elif resume and (folder / FILE).exists():
            raise HistoryError("the run is complete", where=folder, fix="leave out --resume, or change --out")
        else:
            (folder / FILE).unlink(missing_ok=True)
            path.write_bytes(_MAGIC)
        self._journal = path.open("r+b")
        self._journal.truncate(end)
        self._journal.seek(end)

    def __enter__(self) -> History:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(complete=False)

    def begin(self, problem: Problem, fingerprint: str) -> StageHistory:
        """Start (or take up) the stage that `problem` is.

        Raises
        ------
        HistoryError
            The recorded stage was posed differently.
        """
        old = self.stages.get(problem.name)
        if old is not None:
            if old.fingerprint != fingerprint:
                raise HistoryError(
                    f"the campaign has changed since stage '{problem.name}' was recorded",
                    where=self.folder,
                    fix="start anew without --resume",
                )
            return old
        values = problem.space.to_model(problem.space.start)
        head = {
            "stage": problem.name,
            "fingerprint": fingerprint,
            "parameters": list(values),
            "criteria": list(problem.labels),
            "cases": [case.id for case in problem.cases],
            "signals": [[c.signal for c in case.channels] for case in problem.cases],
        }
        self._append("stage", head)
        return self._take(("stage", head))

    def record(self, stage: str, evaluation: Evaluation, purpose: str, improved: bool, *, residuals: bool) -> None:
        """Append one evaluation; with `residuals` if the solver will ask for them when it resumes."""
        row = Row(
            evaluation.x,
            evaluation.parameters,
            evaluation.criteria,
            evaluation.constraints,
            evaluation.cost,
            evaluation.failure,
            purpose,
            evaluation.seconds,
            improved,
            evaluation.residuals if residuals and self._journal is not None else None,
            evaluation.predictions if improved else (),
        )
        self.stages[stage].rows.append(row)
        if stage in self._known:
            self._known[stage][row.search.tobytes()] = row
        self._append("row", {"stage": stage, **_packed(row)})

    def recall(self, stage: str, x: FloatArray, residuals: bool) -> Evaluation | None:
        """Return what an interrupted run found at `x`, if it was recorded."""
        if stage not in self._known:
            self._known[stage] = {row.search.tobytes(): row for row in self.stages[stage].rows}
        row = self._known[stage].get(x.tobytes())
        if row is None or (residuals and row.residuals is None and row.failure is None):
            return None
        return row.evaluation()

    def finish(self, stage: str, result: bytes, asked: str) -> None:
        """Record that a stage is done, with its result and what was to be found about it."""
        self._take(("result", {"stage": stage, "result": result, "asked": asked}))
        self._append("result", {"stage": stage, "result": result, "asked": asked})
        for row_number, row in enumerate(self.stages[stage].rows):
            if row.residuals is not None:  # nobody asks for them again
                object.__setattr__(self.stages[stage].rows[row_number], "residuals", None)

    def write(self) -> None:
        """Write ``history.h5`` in one atomic step."""
        if self.folder is not None:
            hdf5.write_file(self.folder / FILE, lambda file: _fill(file, self.stages.values()))

    def close(self, *, complete: bool) -> None:
        """Close the journal, and remove it if the run is complete."""
        if self._journal is None or self.folder is None:
            return
        self._journal.close()
        self._journal = None
        self.write()
        if complete:
            (self.folder / JOURNAL).unlink()

    def _append(self, kind: str, content: Mapping[str, Any]) -> None:
        if self._journal is None:
            return
        data = msgspec.msgpack.encode((kind, content))
        # One write a record: what the kernel has taken survives the death of the process.
        os.write(self._journal.fileno(), _HEAD.pack(len(data), zlib.crc32(data)) + data)

    def _take(self, record: tuple[str, Mapping[str, Any]]) -> StageHistory:
        kind, content = record
        name = content["stage"]
        if kind == "stage":
            self.stages[name] = StageHistory(
                name,
                content["fingerprint"],
                tuple(content["parameters"]),
                tuple(content["criteria"]),
                tuple(content["cases"]),
                tuple(tuple(s) for s in content["signals"]),
            )
        elif kind == "row":
            self.stages[name].rows.append(_unpacked(content))
        else:
            self.stages[name].result, self.stages[name].asked = content["result"], content["asked"]
        return self.stages[name]


def read_history(path: str | Path) -> Mapping[str, StageHistory]:
    """Read the history of a run folder, by stage.

    Parameters
    ----------
    path
        The folder, or the ``history.h5`` in it.

    Raises
    ------
    HistoryError
        There is none, or it is damaged.
    """
    path = Path(path)
    if path.is_dir() and (path / JOURNAL).exists():
        history = History(None)
        for record, _ in _records(path / JOURNAL):
            history._take(record)
        return history.stages
    try:
        return read_apart(_read, path / FILE if path.is_dir() else path)
    except MeasurementsError as error:
        raise HistoryError(error.what, where=error.where, fix=error.fix) from None


def _read(file: Path) -> Mapping[str, StageHistory]:
    with hdf5.reading(file, HistoryError, fix="run fmuid identify with --out") as source:
        if source.attrs.get("format") != FORMAT or source.attrs.get("version") != VERSION:
            raise HistoryError("is not a fmuid history of version 1", where=file, fix="record it again")
        return {name: _read_stage(name, group) for name, group in source["stages"].items()}


def _records(path: Path) -> Iterator[tuple[tuple[str, Mapping[str, Any]], int]]:
    """Return the whole records of a journal, each with the position after it."""
    with path.open("rb") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise HistoryError("is not a journal of fmuid", where=path, fix="start anew without --resume")
        while len(head := file.read(_HEAD.size)) == _HEAD.size:
            length, checksum = _HEAD.unpack(head)
            data = file.read(length) if length < _LARGEST_RECORD else b""
            if len(data) != length or zlib.crc32(data) != checksum:
                return  # cut short by a kill
            yield msgspec.msgpack.decode(data), file.tell()


def _packed(row: Row) -> dict[str, Any]:
    return {
        "search": row.search.tobytes(),
        "parameters": dict(row.parameters),
        "criteria": row.criteria.tobytes(),
        "constraints": row.constraints.tobytes(),
        "cost": row.cost,
        "failure": row.failure,
        "purpose": row.purpose,
        "seconds": row.seconds,
        "improved": row.improved,
        "residuals": None if row.residuals is None else row.residuals.tobytes(),
        "predictions": [(p.shape, p.tobytes()) for p in row.predictions],
    }


def _unpacked(content: Mapping[str, Any]) -> Row:
    residuals = content["residuals"]
    return Row(
        np.frombuffer(content["search"]),
        content["parameters"],
        np.frombuffer(content["criteria"]),
        np.frombuffer(content["constraints"]),
        # msgpack keeps NaN, and turns no float into an integer.
        content["cost"],
        content["failure"],
        content["purpose"],
        content["seconds"],
        content["improved"],
        None if residuals is None else np.frombuffer(residuals),
        tuple(np.frombuffer(data).reshape(shape) for shape, data in content["predictions"]),
    )


def _fill(file: Any, stages: Any) -> None:
    file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
    parent = file.create_group("stages", track_order=True)
    for stage in stages:
        group = parent.create_group(stage.name)
        group.attrs["fingerprint"] = stage.fingerprint
        for key in ("parameters", "criteria", "cases"):
            group.attrs[key] = list(getattr(stage, key)) or ""
        group.attrs["signals"] = ["\n".join(names) for names in stage.signals]
        rows: Sequence[Row] = stage.rows
        group["parameters"] = _table([[r.parameters[p] for p in stage.parameters] for r in rows])
        n_free = len(rows[0].search) if rows else 0
        group["search"] = _table([r.search[:n_free] for r in rows])
        for key in ("criteria", "constraints"):
            group[key] = _table([getattr(r, key) for r in rows])
        for key in ("cost", "seconds"):
            group[key] = np.array([getattr(r, key) for r in rows], dtype=np.float64)
        group["improved"] = np.array([r.improved for r in rows], dtype=bool)
        group["failure"] = [r.failure or "" for r in rows] or np.zeros(0)
        group["purpose"] = [r.purpose for r in rows] or np.zeros(0)
        for i, row in stage.iterates():
            iterate = group.create_group(f"iterates/{i}")
            for case, prediction in zip(stage.cases, row.predictions, strict=True):
                iterate.create_dataset(case, data=prediction, compression="gzip", compression_opts=1)


def _table(rows: Sequence[Any]) -> FloatArray:
    """Return rows as (n, columns), also where there is none of either."""
    return np.array(rows, dtype=np.float64).reshape(len(rows), len(rows[0]) if rows else 0)


def _read_stage(name: str, group: Any) -> StageHistory:
    labels = {key: tuple(map(str, group.attrs[key])) for key in ("parameters", "criteria", "cases", "signals")}
    columns = {key: group[key][()] for key in ("parameters", "search", "criteria", "constraints")}
    flat = {key: group[key][()] for key in ("cost", "seconds", "improved")}
    failures, purposes = (
        [v.decode() for v in group[key][()]] if len(group[key]) else [] for key in ("failure", "purpose")
    )
    rows = []
    for i in range(len(flat["cost"])):
        iterate = group.get(f"iterates/{i}")
        rows.append(
            Row(
                columns["search"][i],
                dict(zip(labels["parameters"], map(float, columns["parameters"][i]), strict=True)),
                columns["criteria"][i],
                columns["constraints"][i],
                float(flat["cost"][i]),
                failures[i] or None,
                purposes[i],
                float(flat["seconds"][i]),
                bool(flat["improved"][i]),
                None,
                () if iterate is None else tuple(iterate[case][()] for case in labels["cases"]),
            )
        )
    return StageHistory(
        name,
        str(group.attrs["fingerprint"]),
        labels["parameters"],
        labels["criteria"],
        labels["cases"],
        tuple(tuple(s.split("\n")) for s in labels["signals"]),
        rows,
    )
