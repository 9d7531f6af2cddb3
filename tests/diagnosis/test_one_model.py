"""What is reported, fitted, written, simulated and validated is one model."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest

from fmu_build.errors import ModelicaError
from fmuid.campaigns.campaign_toml import load_campaign
from fmuid.core.campaign import Campaign
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.data.measurements import write_measurements
from fmuid.diagnosis.candidates import Fitted, fit_effects
from fmuid.diagnosis.corrected import checked, write_corrected
from fmuid.diagnosis.made_catalogue import with_catalogue
from fmuid.diagnosis.subject import Subject, subject_of, tightened
from fmuid.simulation.coupled.loading import load_simulator
from fmuid.simulation.model_source import built_model
from fmuid.simulation.runners import in_process

RIGS = Path(__file__).parents[1] / "fmu_build" / "models" / "Rigs.mo"
TIME = np.linspace(0.0, 2.0, 101)
INPUTS = {
    "TwoMass": ("tau", "N.m", {"w_motor": "rad/s", "w_load": "rad/s"}, 0.3, 1.0, "rotor.J", 2e-3),
    "Circuit": ("v", "V", {"v_c": "V"}, 5.0, 0.01, "resistor.R", 10.0),
    "Block": ("P", "W", {"T": "K"}, 300.0, 1000.0, "wall.G", 2.0),
    "Tanks": ("q", "m3/s", {"level": "m"}, 1e-3, 100.0, "pipe.k", 2e-3),
}
CAMPAIGN = """
[campaign]
name = "rig"
[models.rig]
source = "{source}"
class = "Rigs.{rig}"
[parameters."{name}"]
start = {value}
lower = {low}
upper = {high}
"""
KINDS = ("kinematic_error", "backlash", "presliding", "coulomb", "gain", "value", "hysteresis")
"""Laws whose ways to act differ: with a reaction, a flow, states, without any, at a signal, at a parameter."""


@dataclass(frozen=True)
class Rig:
    """A rig without any effect, recorded once in each of two experiments."""

    campaign: Campaign

    @cached_property
    def subject(self) -> Subject:
        return subject_of(self.campaign, load_simulator)

    @cached_property
    def nominal(self) -> Fitted:
        fitted = fit_effects(self.subject, (), [{}], iterations=0)
        assert fitted is not None
        return fitted


def recorded(
    name: str, folder: Path, stages: str, shown: Sequence[Mapping[str, np.ndarray]], like: str | None = None
) -> Rig:
    """Write a campaign of two experiments whose outputs are those shown and noise, and return its rig.

    Its inputs and outputs are those of a rig that it is like.
    """
    signal, of_input, outputs, size, scale, parameter, value = INPUTS[like or name]
    text = CAMPAIGN.format(source=RIGS, rig=name, name=parameter, value=value, low=0.5 * value, high=2.0 * value)
    (folder / "campaign.toml").write_text(text + stages)
    rng, runs = np.random.default_rng(0), {}
    for k, (steps, courses) in enumerate(zip((3.0, 7.0), shown, strict=True)):
        u = size * (1.0 + k) * np.sign(np.sin(steps * TIME))
        signals = [Signal(signal, u, of_input, "input")]
        signals += [
            Signal(n, courses.get(n, 0.0) + 1e-3 * rng.standard_normal(TIME.size), unit, "output")
            for n, unit in outputs.items()
        ]
        runs[f"e{k}"] = Experiment(f"e{k}", "rig", scale * TIME, {s.name: s for s in signals})
    write_measurements(Measurements(runs), folder / "measurements.h5")
    return Rig(with_catalogue(load_campaign(folder), load_simulator))


@pytest.fixture(scope="module")
def rigs(tmp_path_factory):
    """Rigs by name, made when they are first asked for."""
    known: dict[str, Rig] = {}

    def made(name: str) -> Rig:
        if name not in known:
            known[name] = recorded(name, tmp_path_factory.mktemp(name), "", [{}, {}])
        return known[name]

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield made


def written_differs(rig: Rig, id: str, folder: Path, *noted: str) -> tuple[float, float]:
    """Return how much the corrected model differs from the fitted one, and how much the effect does.

    The notes are those with the words `noted`, and no others.
    """
    effect = rig.subject.by_id[id]
    values = {**rig.nominal.fit.values, **effect.neutral, **effect.trials[-1]}
    subject = tightened(rig.subject, [values])
    fitted = replace(rig.nominal, effects=(id,), fit=replace(rig.nominal.fit, values=values))
    written = write_corrected(rig.campaign, subject, [id], values, folder=folder, runner=in_process)
    assert written is not None
    plain, with_it = subject.model.predict([rig.nominal.fit.values, values])
    moved = max(float(np.abs(a - b).max()) for a, b in zip(plain, with_it, strict=True))
    written = checked(written, subject, fitted, runner=in_process)
    assert len(written.notes) == len(noted)
    assert all(words in note for words, note in zip(noted, written.notes, strict=True))
    return written.differs, moved


@pytest.mark.parametrize("rig", INPUTS)
@pytest.mark.parametrize("law", KINDS)
def test_the_corrected_model_is_the_fitted_one(rigs, rig, law, tmp_path):
    effects = [e.id for e in rigs(rig).subject.effects if e.law == law]
    if not effects:
        pytest.skip("the law is of another domain")
    differs, moved = written_differs(rigs(rig), effects[0], tmp_path / "corrected")
    assert moved > 0.0
    assert differs < 0.05


TIED = """
[parameters.d]
start = 0.02
lower = 0
upper = 1
[effects]
nominal = ["rotor.J"]
tie = { "table[2:3,2]" = "d", "dashpot.least" = "2 * d" }
"""


def test_elements_of_a_table_and_computed_values_are_in_the_source(rigs, tmp_path):
    del rigs  # its cache is used
    rig = recorded("Damped", tmp_path, TIED, [{}, {}], like="TwoMass")
    differs, moved = written_differs(rig, "coulomb@rotor", tmp_path / "corrected")
    source = (tmp_path / "corrected" / "DampedCorrected.mo").read_text()
    assert "{{0.0, 0.001}, {10.0, 0.02}, {20.0, 0.02}}" in source
    assert "'dashpot.least'(unit = \"N.m.s/rad\") = 0.04" in source
    assert moved > 0.0
    assert differs < 0.05


LED = """
[parameters."table[1,2]"]
start = 0.02
lower = 0
upper = 1
[effects]
nominal = ["rotor.J", "table[1,2]"]
tie = { "table[:,2]" = "table[1,2]" }
"""


def test_elements_of_a_column_follow_its_first_one(rigs, tmp_path):
    del rigs  # its cache is used
    rig = recorded("Damped", tmp_path, LED, [{}, {}], like="TwoMass")
    differs, moved = written_differs(rig, "coulomb@rotor", tmp_path / "corrected")
    source = (tmp_path / "corrected" / "DampedCorrected.mo").read_text()
    assert "{{0.0, 0.02}, {10.0, 0.02}, {20.0, 0.02}}" in source
    assert moved > 0.0
    assert differs < 0.05


def test_models_of_runs_that_were_not_diagnosed_have_the_effect_where_they_have_its_place(rigs, tmp_path):
    """Those of a setup without any runs are as they were."""
    del rigs  # its cache is used
    others = {"geared": "Geared", "circuit": "Circuit", "unused": "Damped"}
    models = "".join(f'[models.{n}]\nsource = "{RIGS}"\nclass = "Rigs.{c}"\n' for n, c in others.items())
    campaign = recorded("TwoMass", tmp_path, models + '[effects]\nexperiments = ["e0", "e1"]\n', [{}, {}]).campaign
    runs = dict(campaign.measurements.experiments)
    runs |= {setup: replace(runs["e0"], id=setup, setup=setup) for setup in ("geared", "circuit")}
    write_measurements(Measurements(runs), tmp_path / "measurements.h5")
    rig = Rig(with_catalogue(load_campaign(tmp_path), load_simulator))
    differs, moved = written_differs(rig, "coulomb@rotor", tmp_path / "corrected", "corrected/: unused")
    written = load_campaign(tmp_path / "corrected")
    starts = {setup: load_simulator(written.models[setup]).variables for setup in ("rig", "geared")}
    assert starts["geared"]["rotor.coulomb"].start == starts["rig"]["rotor.coulomb"].start > 0.0
    assert not [n for n in load_simulator(written.models["circuit"]).variables if "coulomb" in n]
    assert written.models["unused"].source == replace(
        campaign.models["unused"].source, file=written.models["unused"].source.file
    )
    assert moved > 0.0
    assert differs < 0.05


def test_a_model_of_other_runs_that_cannot_have_the_effect_is_as_it_was(rigs, tmp_path, monkeypatch):
    del rigs  # its cache is used
    other = f'[models.geared]\nsource = "{RIGS}"\nclass = "Rigs.Geared"\n[effects]\nexperiments = ["e0", "e1"]\n'
    campaign = recorded("TwoMass", tmp_path, other, [{}, {}]).campaign
    runs = dict(campaign.measurements.experiments)
    write_measurements(
        Measurements({**runs, "e2": replace(runs["e0"], id="e2", setup="geared")}), tmp_path / "measurements.h5"
    )
    rig = Rig(with_catalogue(load_campaign(tmp_path), load_simulator))

    def built(source):
        if source.class_name == "Rigs.Geared" and source.effects is not None:
            raise ModelicaError("singular")
        return built_model(source)

    monkeypatch.setattr("fmuid.diagnosis.corrected.built_model", built)
    notes = "cannot be added to the model of 'geared': singular", "as they were in corrected/: geared"
    differs, moved = written_differs(rig, "coulomb@rotor", tmp_path / "corrected", *notes)
    assert load_campaign(tmp_path / "corrected").models["geared"].source.effects is None
    assert moved > 0.0
    assert differs < 0.05


@pytest.mark.parametrize("read_after", [0.01, 0.005, 0.0])
def test_outputs_are_read_in_the_corrected_campaign_as_in_the_diagnosis(rigs, read_after, tmp_path):
    """The file says 0.01 s; the diagnosis found that, another time, or none."""
    del rigs  # its cache is used
    recorded("TwoMass", tmp_path, "", [{}, {}])
    file = tmp_path / "campaign.toml"
    file.write_text(file.read_text().replace("[models.rig]", "[models.rig]\nread_after = 0.01"))
    campaign = load_campaign(tmp_path)
    models = {"rig": replace(campaign.models["rig"], read_after=read_after)}
    rig = Rig(with_catalogue(replace(campaign, models=models), load_simulator))
    differs, moved = written_differs(rig, "coulomb@rotor", tmp_path / "corrected")
    assert moved > 0.0
    assert differs < 0.05
    assert load_campaign(tmp_path / "corrected").models["rig"].read_after == read_after


@pytest.mark.parametrize(
    ("rig", "id"),
    [
        ("TwoMass", "presliding@rotor"),  # has a state of its own
        ("TwoMass", "lag@w_load"),  # at a sensor, through which start states are seen
        ("Circuit", "offset@v"),
        ("Block", "delay@T"),
        ("Tanks", "saturation@level"),
    ],
)
def test_runs_with_estimated_starts_are_corrected_as_they_were_fitted(rigs, rig, id, tmp_path):
    plain = rigs(rig).subject
    (predicted,) = plain.model.predict([plain.starts])
    shown = [dict(zip(INPUTS[rig][2], rows, strict=True)) for rows in predicted]
    started = recorded(rig, tmp_path, '[stages.all]\nsegments = "run"\n', shown)
    differs, moved = written_differs(started, id, tmp_path / "corrected")
    assert moved > 0.0
    assert differs < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("rig", INPUTS)
def test_every_law_is_written_as_it_was_fitted(rigs, rig, tmp_path):
    kinds = {(e.law, e.acts, bool(e.flow), bool(e.states)): e.id for e in rigs(rig).subject.effects}
    apart = {id: written_differs(rigs(rig), id, tmp_path / "corrected")[0] for id in kinds.values()}
    assert {id: differs for id, differs in apart.items() if differs >= 0.05} == {}
