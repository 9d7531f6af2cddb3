"""Creating a campaign from logs and a model: `fmuid init` for notebooks and scripts."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fmuid.campaigns.campaign_toml import FILE_NAME, load_campaign
from fmuid.core.campaign import Campaign, ModelSource, is_modelica
from fmuid.core.errors import CampaignError, FmuidError
from fmuid.data.recordings.resampling import TimeBase
from fmuid.data.table_layout import TableLayout
from fmuid.init.new_campaign import new_campaign
from fmuid.simulation.pool.choice import runner_on


@dataclass(frozen=True, slots=True)
class GivenModel:
    """An FMU, and the Modelica source that it was built from, if any."""

    fmu: Path
    source: ModelSource | None = None


def given_model(model: Path, class_name: str | None = None, roots: Sequence[Path] = ()) -> GivenModel:
    """Return the FMU at a path; for a Modelica file, build it with the libraries in `roots`.

    Raises
    ------
    FmuidError
        The FMU cannot be built, or `class_name` or `roots` are given without a Modelica file.
    """
    if not is_modelica(model):
        for what, value in (("a class", class_name), ("folders of libraries", roots)):
            if value:
                fix = "give the Modelica file (.mo) in its place"
                raise FmuidError(f"{what} without a Modelica model", where=model, fix=fix)
        return GivenModel(model)
    source = ModelSource.at(model, class_name, roots=roots)
    from fmuid.simulation.model_source import built_model, with_libraries  # slow to import

    return GivenModel(built_model(source), with_libraries(source))


def by_name(files: Sequence[Path]) -> dict[str, Path]:
    """Return run files by run name, the stem of the file.

    Raises
    ------
    CampaignError
        Two files have the same name.
    """
    named: dict[str, Path] = {}
    for file in files:
        if file.stem in named:
            raise CampaignError(f"two runs are named '{file.stem}'", where=file, fix="rename one file")
        named[file.stem] = file
    return named


def start(
    logs: Any,
    model: str | Path,
    *,
    class_name: str | None = None,
    roots: Sequence[str | Path] = (),
    out: str | Path = "campaign",
    replace: bool = False,
    signals: Collection[str] = (),
    base: TimeBase | None = None,
    units: Mapping[str, str] | None = None,
    sigmas: Mapping[str, float] | None = None,
    columns: Sequence[str] = (),
    rate: float | None = None,
    workers: int | None = 0,
    say: Callable[[str], object] = print,
) -> Campaign:
    """Create a campaign from recorded runs and a model, as ``fmuid init`` does, and return it.

    Columns are matched with the model's inputs and outputs by name or unit. Parameters that the runs determine are
    free. With three or more runs, the last one is kept for validation, unless one of few others would then be the
    only one in its range of an input.

    Parameters
    ----------
    logs
        A file or a data frame (pandas, polars, pyarrow), or several: a sequence of files, or files and frames by
        run name. Columns state units as in ``tau [N.m]``; one is named ``time``.
    model
        An FMU, an SSP file, or a Modelica file, whose class is `class_name` or has the name of the file.
    roots
        Folders of the libraries that a Modelica model uses, such as the Modelica Standard Library.
    out, replace
        Folder of the campaign; an existing one is only replaced if `replace` is True.
    signals
        Signals to use; all by default.
    base
        Common time base for signals with different time bases.
    units, sigmas
        Units (these win over the logs') and noise standard deviations by column.
    columns
        Column headers for CSV files without a header, or chosen columns as ``HEADER=SOURCE``; see
        `fmuid.data.table_layout.TableLayout`.
    rate
        Samples per second of logs without times.
    workers
        Number of worker processes; 0 for none, None for one per processor.
    say
        Called with one line for each guess.

    Returns
    -------
    Campaign
        Ready for `fmuid.identify`; look through its ``campaign.toml`` first.

    Raises
    ------
    FmuidError
        A log cannot be read, no column matches the model, or the campaign already exists.
    fmu_build.errors.ModelicaError
        The Modelica source has an error, or needs a library that is not in `roots`.

    Examples
    --------
    >>> campaign = fmuid.start("log.csv", model="Tank.mo", say=lambda line: None)
    >>> result = fmuid.identify(campaign)
    >>> round(result.parameters["G"], 1)
    8.0
    >>> fmuid.diagnose(result).diagnosis.verdict.kind
    'complete'
    """
    folder = Path(out)
    if (folder / FILE_NAME).exists() and not replace:
        raise CampaignError(
            "already exists", where=folder / FILE_NAME, fix="replace it with replace=True, or choose another out="
        )
    given = given_model(Path(model), class_name, [Path(root) for root in roots])
    with runner_on(workers) as runner:
        made = new_campaign(
            _runs(logs),
            given.fmu,
            folder,
            replacing=replace,
            source=given.source,
            signals=signals,
            base=base,
            units=units,
            sigmas=sigmas,
            layout=TableLayout(tuple(columns), rate),
            runner=runner,
        )
    for line in (*made.guesses, *map(str, made.not_looked_for)):
        say(line)
    return load_campaign(folder)


def _runs(logs: Any) -> Mapping[str, Any]:
    if isinstance(logs, (str, Path)):
        return by_name([Path(logs)])
    if not isinstance(logs, (Mapping, Sequence)):
        return {"log": logs}
    if not logs:
        raise CampaignError("there are no logs", fix="give at least one")
    if isinstance(logs, Mapping):
        return {str(id): Path(log) if isinstance(log, (str, Path)) else log for id, log in logs.items()}
    unnamed = next((log for log in logs if not isinstance(log, (str, Path))), None)
    if unnamed is not None:
        what = f"a sequence of logs has a '{type(unnamed).__name__}', which has no name"
        raise CampaignError(what, fix="give files, or files and data frames by run name, as in {'first': frame}")
    return by_name([Path(log) for log in logs])
