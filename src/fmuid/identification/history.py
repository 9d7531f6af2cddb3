"""Every evaluation of an identification, recorded on disk and safe against a kill at any moment.

During a run, each evaluation is one record at the end of ``history.journal`` (`fmuid.core.journal`). When the run
ends (Ctrl-C included), its result becomes the journal's last record, the content is written to ``history.h5`` in
one atomic step, ``result.json`` follows, and if the run is complete the journal is removed last. While there is a
journal, it takes precedence, so the result can be read whenever a run was killed. An interrupted run is resumed by
running it again: solvers are deterministic, and recorded evaluations are not simulated again, so the run continues
exactly where it stopped.

``history.h5``, version 1: root attributes ``format = "fmuid-history"``, ``version``, and a dataset ``result``, the
bytes of ``result.json``. For each stage a group ``/stages/<name>`` with attributes ``parameters`` (names of the
columns), ``criteria`` (labels), ``cases``, ``signals`` and datasets with one row per evaluation:

================  ==================  ===================================================================
``parameters``    (n, n_parameters)   model space
``search``        (n, n_free)         search space
``criteria``      (n, n_criteria)     divided by their demands; NaN if failed
``constraints``   (n, n_constraints)
``cost``          (n,)                NaN if failed
``failure``       (n,)                text, empty if it did not fail
``purpose``       (n,)                search, derivative, uncertainty (also moves fixed parameters) or pareto
``seconds``       (n,)                wall time
``improved``      (n,)                whether it was the best so far
================  ==================  ===================================================================

and ``iterates/<row>/<case>``, (signals, N): the predictions of each row that improved.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from fmuid.core.errors import FmuidError, MeasurementsError
from fmuid.core.files import make_folder
from fmuid.core.immutable import FloatArray, read_only
from fmuid.core.journal import Journal, check_resumable, records
from fmuid.data import hdf5
from fmuid.data.isolated_reader import read_isolated
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation
from fmuid.identification.recorded_rows import Row, Rows

JOURNAL, FILE = "history.journal", "history.h5"
FORMAT, VERSION = "fmuid-history", 1
_MAGIC = b"fmuid-journal 2\n"
_LARGEST = 64_000_000  # bytes of a journal up to which residuals are recorded


class HistoryError(FmuidError):
    """A history cannot be read, or belongs to another problem."""


@dataclass(slots=True, eq=False)
class StageHistory:
    """The evaluations of one stage, in order.

    Parameters
    ----------
    name, fingerprint
        Name of the stage, and a hash of everything that its evaluations depend on.
    parameters, criteria, cases, signals
        Names of its parameters, criteria and cases, and the signals of each case.
    rows
        The evaluations.
    begun, result
        The stage's result as JSON, before the first evaluation and at the end.
    asked
        The analyses requested for the result.
    """

    name: str
    fingerprint: str
    parameters: tuple[str, ...]
    criteria: tuple[str, ...]
    cases: tuple[str, ...]
    signals: tuple[tuple[str, ...], ...]
    rows: Rows = field(default_factory=Rows)
    begun: bytes | None = None
    result: bytes | None = None
    asked: str = ""

    @property
    def costs(self) -> FloatArray:
        """(n,) costs."""
        return read_only(self.rows.costs)

    def iterates(self) -> Iterator[tuple[int, Row]]:
        """Return the rows that improved, with their numbers."""
        return ((i, self.rows[i]) for i in np.flatnonzero(self.rows.improved).tolist())


@dataclass(slots=True, eq=False)
class RecordedRun:
    """Everything recorded of a run; results are JSON.

    `begun` is the run's result before its first stage, `result` its final result, None if it was killed.
    """

    stages: dict[str, StageHistory] = field(default_factory=dict)
    begun: bytes | None = None
    result: bytes | None = None

    def take(self, kind: str, content: Mapping[str, Any]) -> None:
        """Add one record of a journal."""
        self.result = None  # replaced by what follows, as the run continued
        match kind:
            case "run":
                self.begun = content["begun"]
            case "stage":
                self.stages[content["stage"]] = StageHistory(
                    content["stage"],
                    content["fingerprint"],
                    tuple(content["parameters"]),
                    tuple(content["criteria"]),
                    tuple(content["cases"]),
                    tuple(tuple(s) for s in content["signals"]),
                    begun=content["begun"],
                )
            case "row":
                self.stages[content["stage"]].rows.append(_unpacked(content))
            case "result":
                stage = self.stages[content["stage"]]
                stage.result, stage.asked = content["result"], content["asked"]
            case "end":
                self.result = content["result"]


class History:
    """The history of one run folder, open for appending.

    Parameters
    ----------
    folder
        The run folder, or None to keep the history in memory.
    resume
        Continue from the journal of an interrupted run; if False, the history of a complete run is replaced.
    begun
        The run's result before its first stage, as JSON.

    Raises
    ------
    JournalError
        The folder contains an interrupted run and `resume` is False, or a complete run and `resume` is True.
    """

    def __init__(self, folder: Path | None, *, resume: bool = False, begun: bytes = b"") -> None:
        self.folder = folder
        self._run = RecordedRun()
        self._known: dict[str, dict[bytes, int]] = {}
        self._journal: Journal | None = None
        if folder is None:
            return
        make_folder(folder)
        path = folder / JOURNAL
        recorded, end = _read_journal(path) if path.exists() else (RecordedRun(), None)
        worked = any(stage.rows for stage in recorded.stages.values())
        check_resumable(folder, resume, interrupted=worked, complete=end is None and (folder / FILE).exists())
        if resume:
            self._run = recorded
        self._journal = Journal(path, _MAGIC, end=end if resume else None)
        self._append("run", {"begun": begun})
        self._run.take("run", {"begun": begun})

    def __enter__(self) -> History:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(FmuidError) if error is not None else nullcontext():  # the journal has everything
            self.close(complete=False)

    @property
    def stages(self) -> Mapping[str, StageHistory]:
        """Recorded evaluations, by stage."""
        return self._run.stages

    def begin(self, problem: Problem, fingerprint: str, begun: bytes) -> StageHistory:
        """Start or continue the stage of `problem`; `begun` is its JSON result before the first evaluation.

        Raises
        ------
        HistoryError
            The recorded stage had a different problem.
        """
        old = self.stages.get(problem.name)
        if old is not None:
            if old.fingerprint != fingerprint:
                raise HistoryError(
                    f"the campaign has changed since stage '{problem.name}' was recorded",
                    where=self.folder,
                    fix="undo the change, or choose another folder",
                )
            return old
        values, _ = problem.space.tried(problem.space.start)
        head = {
            "stage": problem.name,
            "fingerprint": fingerprint,
            "parameters": list(values),
            "criteria": list(problem.labels),
            "cases": [case.id for case in problem.cases],
            "signals": [[c.signal for c in case.channels] for case in problem.cases],
            "begun": begun,
        }
        self._append("stage", head)
        self._run.take("stage", head)
        return self.stages[problem.name]

    def record(self, stage: str, evaluation: Evaluation, purpose: str, improved: bool, *, residuals: bool) -> None:
        """Append one evaluation; include `residuals` if the solver needs them when it resumes."""
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
            evaluation.residuals if residuals and self._journal is not None and not self._full else None,
            evaluation.predictions if improved else (),
        )
        rows = self.stages[stage].rows
        rows.append(row)
        if stage in self._known:
            rows.prefer(self._known[stage], row.search.tobytes(), len(rows) - 1)
        self._append("row", {"stage": stage, **_packed(row)})

    @property
    def _full(self) -> bool:
        """Whether the journal is so large that an interrupted search has to repeat evaluations to resume."""
        return self._journal is not None and self._journal.size >= _LARGEST

    def recall(self, stage: str, x: FloatArray, residuals: bool) -> Evaluation | None:
        """Return the evaluation of an interrupted run at `x`, if recorded."""
        if stage not in self._known:
            self._known[stage] = self.stages[stage].rows.numbers
        number = self._known[stage].get(x.tobytes())
        row = None if number is None else self.stages[stage].rows[number]
        if row is None or (residuals and row.residuals is None and row.failure is None):
            return None
        return row.evaluation()

    def finish(self, stage: str, result: bytes, asked: str) -> None:
        """Record that a stage is done, with its result and its analyses."""
        record = {"stage": stage, "result": result, "asked": asked}
        self._append("result", record)
        self._run.take("result", record)
        self.stages[stage].rows.forget_residuals()  # no longer needed

    def conclude(self, result: bytes) -> None:
        """Record the final result of the run as JSON, and write ``history.h5``."""
        self._append("end", {"result": result})
        self._run.take("end", {"result": result})
        self._write()

    def close(self, *, complete: bool) -> None:
        """Close the journal, and remove it if the run is complete and its result has been written."""
        if self._journal is None or self._journal.closed:
            return
        journal, self._journal = self._journal, None
        journal.close(remove=complete)
        if not complete and self._run.result is None:
            self._write()

    def _write(self) -> None:
        if self.folder is not None:
            hdf5.write_file(self.folder / FILE, lambda file: _fill(file, self._run))

    def _append(self, kind: str, content: Mapping[str, Any]) -> None:
        if self._journal is not None and not self._journal.closed:
            self._journal.append((kind, content), lasting=kind != "row")


class FollowedRun:
    """A run folder while another process writes to it; each look reads only what is new.

    Parameters
    ----------
    folder
        The run folder, which need not exist yet.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.run = RecordedRun()
        self._seen: tuple[int, int] | None = None  # the journal's file, and the position after its last record

    @property
    def in_progress(self) -> bool:
        """Whether the run is being made, or was interrupted."""
        return self._seen is not None

    def look(self) -> bool:
        """Read what was added since the last look; return whether there was anything.

        Raises
        ------
        HistoryError, JournalError
            The history is damaged.
        """
        path = self.folder / JOURNAL
        try:
            state = path.stat()
        except FileNotFoundError:
            return self._concluded()
        number, end = self._seen or (-1, 0)
        if number != state.st_ino or state.st_size < end:
            self.run, end = RecordedRun(), 0
        before = end
        try:
            for (kind, content), _, after in records(path, _MAGIC, end or None):
                self.run.take(kind, content)
                end = after
        except FileNotFoundError:
            return self._concluded()
        self._seen = state.st_ino, end
        return end != before

    def _concluded(self) -> bool:
        """Take the history of a run that is complete."""
        if self._seen is None and (self.run.stages or not (self.folder / FILE).exists()):
            return False
        self._seen = None
        self.run = read_run(self.folder) if (self.folder / FILE).exists() else RecordedRun()
        return True


def read_history(path: str | Path) -> Mapping[str, StageHistory]:
    """Read the history of a run folder, by stage.

    Parameters
    ----------
    path
        The folder, or the ``history.h5`` in it.

    Raises
    ------
    HistoryError
        The history is missing or damaged.
    """
    return read_run(path).stages


def read_run(path: str | Path) -> RecordedRun:
    """Read everything recorded of a run; see `read_history`."""
    path = Path(path)
    if path.is_dir() and (path / JOURNAL).exists():
        return _read_journal(path / JOURNAL)[0]
    try:
        return read_isolated(_read, path / FILE if path.is_dir() else path)
    except MeasurementsError as error:
        raise HistoryError(error.what, where=error.where, fix=error.fix) from None


def _read(file: Path) -> RecordedRun:
    with hdf5.reading(file, HistoryError, fix="run fmuid identify with --out") as source:
        if source.attrs.get("format") != FORMAT or source.attrs.get("version") != VERSION:
            raise HistoryError("is not an fmuid history of version 1", where=file, fix="record it again")
        result = source["result"][()].tobytes() if "result" in source else None
        stages = {name: _read_stage(name, group) for name, group in source["stages"].items()}
        return RecordedRun(stages, result=result or None)


def _read_journal(path: Path) -> tuple[RecordedRun, int]:
    """Return the contents of the complete records of a journal, and the position after them."""
    run, end = RecordedRun(), len(_MAGIC)
    for (kind, content), _, end in records(path, _MAGIC):  # noqa: B007 - the last end counts
        run.take(kind, content)
    return run, end


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
        # msgpack keeps NaN, and converts no float to an integer.
        content["cost"],
        content["failure"],
        content["purpose"],
        content["seconds"],
        content["improved"],
        None if residuals is None else np.frombuffer(residuals),
        tuple(np.frombuffer(data).reshape(shape) for shape, data in content["predictions"]),
    )


def _fill(file: Any, run: RecordedRun) -> None:
    file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
    file["result"] = np.frombuffer(run.result or b"", dtype=np.uint8)
    parent = file.create_group("stages", track_order=True)
    for stage in run.stages.values():
        group = parent.create_group(stage.name)
        group.attrs["fingerprint"] = stage.fingerprint
        for key in ("parameters", "criteria", "cases"):
            group.attrs[key] = list(getattr(stage, key)) or ""
        group.attrs["signals"] = ["\n".join(names) for names in stage.signals]
        rows = stage.rows
        group["parameters"] = rows.parameters(stage.parameters)
        for key in ("search", "criteria", "constraints", "seconds", "improved"):
            group[key] = getattr(rows, key)
        group["cost"] = rows.costs
        group["failure"] = rows.failures or np.zeros(0)
        group["purpose"] = rows.purposes or np.zeros(0)
        for i, row in stage.iterates():
            iterate = group.create_group(f"iterates/{i}")
            for case, prediction in zip(stage.cases, row.predictions, strict=True):
                iterate.create_dataset(case, data=prediction, compression="gzip", compression_opts=1)


def _read_stage(name: str, group: Any) -> StageHistory:
    labels = {key: tuple(map(str, group.attrs[key])) for key in ("parameters", "criteria", "cases", "signals")}
    columns = {key: group[key][()] for key in ("search", "criteria", "constraints", "parameters")}
    failures, purposes = (
        (v.decode() for v in group[key][()]) if len(group[key]) else () for key in ("failure", "purpose")
    )
    iterates = group.get("iterates", {})
    rows = Rows.of_columns(
        labels["parameters"],
        [*columns.values(), np.column_stack([group["cost"][()], group["seconds"][()]])],
        purposes,
        improved=group["improved"][()],
        failures={k: failure for k, failure in enumerate(failures) if failure},
        predictions={int(k): tuple(iterates[k][case][()] for case in labels["cases"]) for k in iterates},
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
