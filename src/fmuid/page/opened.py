"""Opening the page on a campaign, a run, or logs and a model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fmuid.core.errors import FmuidError
from fmuid.data.table_layout import TableLayout
from fmuid.diagnosis.corrected import read_diagnosis
from fmuid.diagnosis_pipeline import FILE_NAME as DIAGNOSIS
from fmuid.identification.continued import is_run
from fmuid.identification.result import Result
from fmuid.init.new_campaign import new_campaign
from fmuid.init.starting import GivenModel, by_name
from fmuid.page.workspace import Workspace
from fmuid.simulation.runners import Runner, in_process


@dataclass(frozen=True, slots=True)
class NewFrom:
    """A model and options for a new campaign from logs; see `fmuid.init.new_campaign.new_campaign`."""

    model: GivenModel
    folder: Path
    units: Mapping[str, str] = field(default_factory=dict)
    sigmas: Mapping[str, float] = field(default_factory=dict)
    layout: TableLayout | None = None


def open_page(
    what: Sequence[Path],
    new: NewFrom | None = None,
    *,
    runner: Runner = in_process,
    port: int = 0,
    browser: bool = True,
    trust: bool = False,
    say: Callable[[str], object] = print,
) -> None:
    """Serve the page until Ctrl-C.

    Parameters
    ----------
    what
        A campaign, a run folder, or logs.
    new
        The model of logs, and where their campaign goes.
    runner
        Runner of the simulations.
    port, browser
        Port (0 for a free one), and whether to open the browser.
    trust
        Whether functions that the campaign names may be called.
    say
        Called with each line for the user; the last one is the address.

    Raises
    ------
    FmuidError
        The campaign cannot be read or created, or the port is in use.
    """
    from fmuid.page.serving import serve

    diagnosis = next((path for path in what if (path / DIAGNOSIS).is_file()), None)
    workspace = workspace_of(what, new, runner=runner, trust=trust, say=say)
    run = (
        what[0]
        if is_run(what[0])
        else Path("runs")
        / str(workspace.file.tables.get("campaign", {}).get("name") or workspace.folder.resolve().name)
    )
    first = "Look" if diagnosis is not None else "Run" if is_run(what[0]) else "Prepare"

    def build() -> None:
        from fmuid.page.shell import Shell

        Shell(workspace, run, diagnosis=diagnosis, first=first)

    serve(build, title=f"fmuid: {workspace.folder.resolve().name}", port=port, browser=browser, say=say)


def workspace_of(
    what: Sequence[Path],
    new: NewFrom | None = None,
    *,
    runner: Runner = in_process,
    trust: bool = False,
    say: Callable[[str], object] = print,
) -> Workspace:
    """Return the workspace of a campaign, a run or logs; see `open_page`."""
    if new is None:
        if len(what) != 1:
            raise FmuidError(
                "several files, but no model", where=what[1], fix="give --model FILE.mo or --fmu FILE.fmu"
            )
        (path,) = what
        if (path / DIAGNOSIS).is_file():
            campaign = read_diagnosis(path / DIAGNOSIS)["campaign"]
            if campaign is None:
                raise FmuidError("names no campaign", where=path / DIAGNOSIS, fix="open its campaign instead")
            return Workspace(Path(campaign), runner=runner, trust=trust)
        if is_run(path):
            return Workspace(Path(Result.from_json(path).source), runner=runner, trust=trust)
        if path.is_file() and path.suffix != ".toml":
            raise FmuidError("is a log without a model", where=path, fix="give --model FILE.mo or --fmu FILE.fmu")
        return Workspace(path, runner=runner, trust=trust)
    logs = by_name(what)
    made = new_campaign(
        logs,
        new.model.fmu,
        new.folder,
        source=new.model.source,
        units=new.units,
        sigmas=new.sigmas,
        layout=new.layout,
        runner=runner,
    )
    for line in made.guesses:
        say(line)
    return Workspace(new.folder, logs, layout=new.layout, runner=runner, trust=trust)
