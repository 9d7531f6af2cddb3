"""Starting a campaign from the result of an identification."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from fmuid.core.campaign import SEPARATOR, Campaign
from fmuid.core.errors import CampaignError, ProblemError
from fmuid.identification.history import JOURNAL
from fmuid.identification.result import FILE, Result
from fmuid.identification.solvers import Status


def is_run(path: Path) -> bool:
    """Return whether a folder was written by `fmuid identify`."""
    return any((path / name).is_file() for name in (FILE, JOURNAL)) and not (path / "campaign.toml").is_file()


def continued(campaign: Campaign, result: Result) -> Campaign:
    """Return the campaign with identified values as the start values of its parameters.

    Raises
    ------
    ProblemError
        The identification failed.
    CampaignError
        The result belongs to another campaign: this one lacks a parameter.
    """
    if result.status is Status.FAILED or not result.parameters:
        raise ProblemError("the identification has no result to start from", fix="identify again")
    parameters = dict(campaign.parameters)
    for name, value in result.parameters.items():
        if name.startswith("observer["):
            continue
        name, of_one, owner = name.partition(SEPARATOR)
        if name not in parameters:
            raise CampaignError(
                f"parameter '{name}' of the result is not in campaign '{campaign.name}'",
                where="--from",
                fix="start from an identification of this campaign",
            )
        spec = parameters[name]
        value = min(max(value, spec.lower), spec.upper)
        known = {"starts": {**spec.starts, owner: value}} if of_one else {"start": value}
        parameters[name] = replace(spec, **known)
    return replace(campaign, parameters=parameters)
