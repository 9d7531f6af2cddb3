"""`fmuid effects`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fmuid.cli.libraries import Roots
from fmuid.cli.output import Json, Printer, Quiet, writable
from fmuid.cli.supervised import MemoryLimit, TimeLimit, Workers, supervised
from fmuid.core.errors import CampaignError
from fmuid.core.files import check_folder

if TYPE_CHECKING:
    from fmuid.init.not_looked_for import NotLookedFor
    from fmuid.simulation.runners import Runner


def effects(
    what: Annotated[
        Path,
        typer.Argument(
            metavar="CAMPAIGN|MODEL.mo", help="A campaign, a Modelica file, or the folder of a package."
        ),
    ],
    class_name: Annotated[
        str | None, typer.Argument(metavar="[CLASS]", help="Class name (default: file name).")
    ] = None,
    root: Roots = None,
    out: Annotated[
        Path | None, typer.Option(help="Write the catalogue of a campaign to this file.", callback=writable)
    ] = None,
    workers: Workers = None,
    time_limit: TimeLimit = None,
    memory_limit: MemoryLimit = None,
    json: Json = None,
    quiet: Quiet = False,
) -> None:
    """List the places of a model where something may be missing, and the laws that may act there.

    For a campaign, also write an editable catalogue, with sizes from the recorded runs; `fmuid diagnose` generates
    the same one.

    Example: fmuid effects campaigns/drive --out campaigns/drive/effects.toml
    """
    from dataclasses import asdict

    from fmuid.core.campaign import is_modelica

    printer = Printer(quiet, json)
    if out is not None:
        check_folder(out.parent)
    if is_modelica(what) and not (what / "campaign.toml").is_file():
        if out is not None:
            raise CampaignError(
                "sizes of effects come from recorded runs, which a model does not have",
                where="--out",
                fix="choose a campaign, made with: fmuid init LOG... --model MODEL.mo",
            )
        laws_at, unlooked = _of_model(what, class_name, root or [])
    elif root:
        fix = "write them in campaign.toml, as `roots` of a model"
        raise CampaignError("the libraries of a campaign are in its campaign.toml", where="--root", fix=fix)
    else:
        with printer.working("simulating the runs"), supervised(workers, time_limit, memory_limit) as runner:
            text, laws_at, unlooked = _of_campaign(what, runner)
        if out is not None:
            from fmuid.core.files import write_atomically

            write_atomically(out, text)
    width = max((len(name) for name in laws_at), default=0)
    for name, laws in laws_at.items():
        printer.say(f"{name:<{width}}  {', '.join(dict.fromkeys(laws))}")
    for line in unlooked:
        printer.say(str(line))
    if out is not None:
        printer.say(f'{out}: to use it, write in campaign.toml: [effects] catalogue = "{out.name}"')
    ports = {name: list(dict.fromkeys(laws)) for name, laws in laws_at.items()}
    printer.write({"ports": ports, "not_looked_for": [asdict(n) for n in unlooked], "out": out})


def _of_model(
    file: Path, class_name: str | None, roots: list[Path]
) -> tuple[dict[str, list[str]], tuple[NotLookedFor, ...]]:
    from fmu_build.flat_model import constant
    from fmu_build.model_ports import held_parameters
    from fmuid.core.campaign import ModelSource
    from fmuid.diagnosis.made_catalogue import possible_laws
    from fmuid.init.not_looked_for import inside
    from fmuid.simulation.model_source import flat_model

    flat = flat_model(ModelSource.at(file, class_name, roots=roots))
    laws_at = possible_laws(flat) | {v.name: ["value"] for v in held_parameters(flat) if constant(v.binding)}
    return laws_at, tuple(inside(flat))


def _of_campaign(folder: Path, runner: Runner) -> tuple[str, dict[str, list[str]], tuple[NotLookedFor, ...]]:
    import tomllib

    from fmuid.campaigns.campaign_toml import load_campaign
    from fmuid.diagnosis.made_catalogue import made_catalogue
    from fmuid.init.not_looked_for import not_looked_for
    from fmuid.simulation.coupled.loading import load_simulator

    campaign = load_campaign(folder)
    text = made_catalogue(campaign, load_simulator, runner=runner)
    laws_at: dict[str, list[str]] = {}
    for name, effect in tomllib.loads(text)["effects"].items():
        laws_at.setdefault(effect["port"], []).append(name.partition("@")[0])
    return text, laws_at, not_looked_for(campaign, load_simulator, runner)
