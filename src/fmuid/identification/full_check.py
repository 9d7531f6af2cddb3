"""The whole check of a campaign, as `fmuid check` and the page make it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fmuid.core.campaign import Campaign
from fmuid.identification.check import Effect, Finding, check_effects, check_signals, match_models
from fmuid.identification.identify import check_stages
from fmuid.simulation.runners import Runner
from fmuid.simulation.simulator import Simulator


@dataclass(frozen=True, slots=True)
class Checked:
    """The findings of a check, and the effect of each free parameter where it was simulated."""

    findings: tuple[Finding, ...]
    effects: tuple[Effect, ...] = ()

    @property
    def errors(self) -> int:
        """Number of findings that prevent an identification."""
        return sum(finding.level == "error" for finding in self.findings)


def static_check(campaign: Campaign, simulators: Mapping[str, Simulator]) -> Checked:
    """Check names, units, signals and stages without a simulation.

    Raises
    ------
    FmuidError
        Something makes an identification impossible.
    """
    checked = Checked(match_models(campaign, simulators) + check_signals(campaign))
    if not checked.errors:
        check_stages(campaign, simulators)
    return checked


def with_effects(
    checked: Checked, campaign: Campaign, simulators: Mapping[str, Simulator], runner: Runner
) -> Checked:
    """Return a check with the findings of `check_effects`, which simulates on `runner`."""
    findings, effects = check_effects(campaign, simulators, runner)
    return Checked(checked.findings + findings, effects)
