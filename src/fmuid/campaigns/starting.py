"""From logs and a model to a campaign, in one call: what `fmuid init` does, for notebooks and scripts."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fmuid.campaigns.campaign_toml import FILE_NAME, load_campaign
from fmuid.campaigns.new_campaign import new_campaign
from fmuid.core.campaign import Campaign, ModelSource
from fmuid.core.errors import CampaignError, FmuidError
from fmuid.data.recordings.resampling import TimeBase
from fmuid.simulation.model_source import built_model
from fmuid.simulation.pool.choice import runner_on


@dataclass(frozen=True, slots=True)
class GivenModel:
    """An FMU, and the Modelica source that it was built from, if there is one."""

    fmu: Path
    source: ModelSource | None = None


def given_model(model: Path, class_name: str | None = None) -> GivenModel:
    """Return the FMU at a path; the one of a Modelica file is built.

    Raises
    ------
    FmuidError
        It cannot be built, or `class_name` is of no Modelica file.
    """
    if model.suffix.casefold() != ".mo":
        if class_name is not None:
            raise FmuidError(
                "a class without its file", where=model, fix="give the Modelica file (.mo) in its place"
            )
        return GivenModel(model)
    source = ModelSource(model, class_name or model.stem)
    return GivenModel(built_model(source), source)


def by_name(files: Sequence[Path]) -> dict[str, Path]:
    """Return files of runs by the names of the runs, which are theirs.

    Raises
    ------
    CampaignError
        Two of them are called the same.
    """
    named: dict[str, Path] = {}
    for file in files:
        if file.stem in named:
            raise CampaignError(f"two runs are called '{file.stem}'", where=file, fix="rename one file")
        named[file.stem] = file
    return named


def start(
    logs: Any,
    model: str | Path,
    *,
    class_name: str | None = None,
    out: str | Path = "campaign",
    replace: bool = False,
    signals: Collection[str] = (),
    base: TimeBase | None = None,
    units: Mapping[str, str] | None = None,
    sigmas: Mapping[str, float] | None = None,
    columns: Sequence[str] = (),
    workers: int | None = 0,
    say: Callable[[str], object] = print,
) -> Campaign:
    """Start a campaign from recorded runs and a model, and return it; as ``fmuid init`` does.

    Columns become signals by the name or the unit of the model's inputs and outputs. Parameters that the runs
    determine are free. The last of three runs or more is kept for validation.

    Parameters
    ----------
    logs
        A file or a data frame (pandas, polars, pyarrow), or several: a sequence of files, or files and frames by
        name of the run. Columns state units as in ``tau [N.m]``; one is called ``time``.
    model
        An FMU, an SSP file, or a Modelica file, whose class is called like it or `class_name`.
    out, replace
        Folder of the campaign; one that is there is only replaced if asked for.
    signals
        Those to use; all by default.
    base
        What signals with different time bases are brought onto.
    units, sigmas
        Units (these win over the logs') and noise standard deviations by column.
    columns
        Headers of CSV files that have none.
    workers
        Worker processes to simulate in; 0 for none, None for one a processor.
    say
        Hears what was guessed, a line each.

    Returns
    -------
    Campaign
        Ready for `fmuid.identify`; its ``campaign.toml`` is there to look through.

    Raises
    ------
    FmuidError
        A log cannot be read, nothing in it fits the model, or there is a campaign already.

    Examples
    --------
    >>> campaign = fmuid.start("log.csv", model="MyDrive.mo")  # doctest: +SKIP
    >>> result = fmuid.identify(campaign)  # doctest: +SKIP
    >>> fmuid.diagnose(result)  # doctest: +SKIP
    """
    folder = Path(out)
    if replace:
        (folder / FILE_NAME).unlink(missing_ok=True)
    given = given_model(Path(model), class_name)
    with runner_on(workers) as runner:
        made = new_campaign(
            _runs(logs),
            given.fmu,
            folder,
            source=given.source,
            signals=signals,
            base=base,
            units=units,
            sigmas=sigmas,
            columns=columns,
            runner=runner,
        )
    for line in made.guesses:
        say(line)
    return load_campaign(folder)


def _runs(logs: Any) -> Mapping[str, Any]:
    if isinstance(logs, (str, Path)):
        return by_name([Path(logs)])
    if isinstance(logs, Mapping):
        return {str(id): Path(log) if isinstance(log, (str, Path)) else log for id, log in logs.items()}
    if isinstance(logs, Sequence):
        return by_name([Path(log) for log in logs])
    return {"log": logs}
