"""The check abroad: its plants and their gaps, the grid, what a case's folder tells, the score, and a case from end to end."""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.abroad.blind import Check, write_case
from benchmarks.abroad.check_rigs import CHECKED_ON
from benchmarks.abroad.compiled import SHAPE
from benchmarks.abroad.gap import SizedPlant
from benchmarks.abroad.grid import label, plan
from benchmarks.abroad.logs import KINDS, NOISES, Recording, decorrelated, drawn_factors, write_logs
from benchmarks.abroad.page import page
from benchmarks.abroad.rehearsal_rigs import REHEARSED_ON
from benchmarks.abroad.rigs import FOUND_ON
from benchmarks.abroad.score import (
    Abroad,
    brier,
    calibration,
    figures,
    good,
    in_class,
    same_verdict,
    scored,
    wrong,
)
from fmuid.cli.app import run
from fmuid.core.errors import FmuidError

BY_MODEL = {rig.model: rig for rig in CHECKED_ON}
BUCK = BY_MODEL["BuckConverter"]


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


# ---- plants ----


@pytest.mark.parametrize("noise", ["coloured", "drift"])
def test_what_noise_has_in_common_from_sample_to_sample_is_taken_away(noise):
    random = np.random.default_rng(1)
    recorded = np.stack([KINDS[noise](np.zeros((1, 12)), np.ones((1, 1)), random)[0] for _ in range(5000)])
    covariance = np.cov(decorrelated(recorded, noise).T)
    assert np.abs(covariance - np.eye(12)).max() < 0.1
    assert np.abs(np.cov(recorded.T) - np.eye(12)).max() > 0.4


def test_a_constant_is_told_from_a_slope_as_well_as_the_noise_allows():
    rig = BY_MODEL["HeatExchanger"]
    plant, coloured = (SizedPlant(rig, dict.fromkeys(rig.parameters, 1.0), noise=n) for n in ("white", "coloured"))
    offset, gain = {"offset@T_in": -2.0}, {"gain@T_in": 0.006}
    assert plant.separation(offset, {"dead_zone@T_in": 2.0}, 3.0) < 1e-3  # a temperature far from zero
    assert plant.separation(offset, gain, 3.0) > 2.0 * coloured.separation(offset, gain, 3.0) > 0.0
    assert plant.gap(offset) > 2.0 * coloured.gap(offset) > 0.0


def test_effects_that_cannot_be_simulated_together_leave_an_infinite_gap():
    rig = BY_MODEL["ShipDrive"]
    plant = SizedPlant(rig, dict.fromkeys(rig.parameters, 1.0))
    effect = {"viscous@engine": -1e7, "viscous@engine.shape": 1.0}
    assert plant.gap(effect) == np.inf
    assert plant.beside(effect, {"viscous@hull": 10.0, "viscous@hull.shape": 1.0}) == np.inf
    assert 0.0 < plant.beside({"offset@U": 0.1}, {"viscous@hull": 10.0, "viscous@hull.shape": 1.0}) < np.inf


def test_the_rigs_of_the_check_are_not_those_that_rules_were_found_on():
    assert {r.model for r in REHEARSED_ON} == {r.model for r in FOUND_ON}
    assert not {r.model for r in CHECKED_ON} & {r.model for r in FOUND_ON}
    assert len(CHECKED_ON) == 8


@pytest.mark.parametrize("rig", REHEARSED_ON, ids=lambda rig: rig.model)
def test_a_rehearsed_plant_is_the_one_in_python(rig):
    (other,) = (r for r in FOUND_ON if r.model == rig.model)
    u = list(rig.inputs.values())[-1]
    readings = (
        rig.simulate({}, {}, rig.time, u),
        other.simulate(dict.fromkeys(other.parameters, 1.0), {}, rig.time, u),
    )
    assert np.abs((readings[0] - readings[1]) / np.array(rig.noise)[:, None]).max() < 1e-4


def test_a_late_sensor_is_late_between_samples_too():
    fine = np.linspace(BUCK.time[0], BUCK.time[-1], 8 * (len(BUCK.time) - 1) + 1)
    u = BUCK.inputs["sine"]
    for law in ("lag", "delay"):
        effect = {f"{law}@i": 0.4 * (BUCK.time[1] - BUCK.time[0])}
        late = BUCK.simulate({}, effect, BUCK.time, u)
        finer = BUCK.simulate({}, effect, fine, np.repeat(np.atleast_2d(u), 8, axis=1)[:, : len(fine)])[:, ::8]
        moved = finer - BUCK.simulate({}, {}, BUCK.time, u)
        assert np.abs(late - finer).max() < 0.02 * np.abs(moved).max()


def test_a_saturated_input_has_one_limit_in_all_runs():
    largest = max(np.abs(u).max() for u in BUCK.inputs.values())
    limited = {n: BUCK.simulate({}, {"saturation@duty": 0.1}, BUCK.time, u) for n, u in BUCK.inputs.items()}
    for name, u in BUCK.inputs.items():
        plain = BUCK.simulate({}, {}, BUCK.time, u)
        assert np.array_equal(limited[name], plain) is bool(np.abs(u).max() <= 0.9 * largest)


@pytest.mark.parametrize("rig", CHECKED_ON + REHEARSED_ON, ids=lambda rig: rig.model)
def test_a_plant_is_integrated_to_well_under_its_noise(rig):
    fine = replace(rig.simulate, substeps=4 * rig.simulate.substeps)
    for u in rig.inputs.values():
        error = (rig.simulate({}, {}, rig.time, u) - fine({}, {}, rig.time, u)) / np.array(rig.noise)[:, None]
        assert np.abs(error).max() < 0.01


@pytest.mark.parametrize("rig", CHECKED_ON, ids=lambda rig: rig.model)
def test_every_effect_fades_with_its_size_and_each_rig_has_enough_of_them(rig):
    u = next(iter(rig.inputs.values()))
    plain = rig.simulate({}, {}, rig.time, u)
    for effect, unit in rig.effects.items():
        if effect in [f"lag@{name}" for name in rig.simulate.inputs]:
            continue  # has to be longer than a step
        tiny = {n: v if n.endswith(SHAPE) else 1e-15 for n, v in unit.items()}
        moved = (rig.simulate({}, tiny, rig.time, u) - plain) / np.array(rig.noise)[:, None]
        assert np.abs(moved).max() < 1e-2, effect
    held = [e for e in rig.effects if e.startswith("value@")]
    assert len(set(rig.effects) - set(rig.outside) - set(held)) >= 6
    assert len(rig.outside) >= 6
    assert held


def test_an_effect_gets_the_size_whose_gap_was_asked_for():
    plant = SizedPlant(BUCK, dict.fromkeys(BUCK.parameters, 1.0))
    for effect in ("voltage_drop@choke", "delay@duty", "chaos@choke.n"):
        sized, gap = plant.sized(BUCK.effects[effect], 4.0)
        assert gap == pytest.approx(4.0, rel=0.06)
        assert plant.gap(sized) == gap
    largest, gap = plant.sized(BUCK.effects["value@clamp.G"], 1e4)
    assert largest == {"value@clamp.G": 0.7}
    assert gap < 1e4


def test_noise_of_inputs_belongs_to_the_floor_as_far_as_it_reaches_the_outputs():
    screw, factors = BY_MODEL["BallScrew"], {}
    size = {"weight@table": 5.0, "weight@table" + SHAPE: 1.0}
    plain, noisy, noisier = (SizedPlant(screw, factors, inputs=n).gap(size) for n in (0.0, 0.003, 0.006))
    assert noisy < 0.2 * plain
    assert noisier == pytest.approx(0.5 * noisy, rel=0.1)


def test_a_gap_is_what_the_free_parameters_cannot_imitate():
    plant = SizedPlant(BUCK, dict.fromkeys(BUCK.parameters, 1.0))
    assert plant.gap({"value@load.R": 0.05}) < 0.01
    assert plant.gap({"value@clamp.G": 0.05}) > 0.3


def test_a_delay_is_told_from_a_lag_the_better_the_more_it_is_repeated():
    plant = SizedPlant(BUCK, dict.fromkeys(BUCK.parameters, 1.0))
    delay, lag = (plant.sized(BUCK.effects[e], 2.0)[0] for e in ("delay@duty", "lag@duty"))
    once, nine_times = (plant.separation(delay, lag, n) for n in (1, 9))
    assert nine_times == pytest.approx(3 * once)
    assert plant.separation(delay, delay, 1) == pytest.approx(0.0, abs=1e-9)
    # They differ just after the input has changed, which half as many samples miss.
    assert plant.separation(delay, lag, 1, every=2) < 0.5 * once


def test_an_effect_that_another_one_imitates_leaves_little_beside_it():
    plant = SizedPlant(BUCK, dict.fromkeys(BUCK.parameters, 1.0))
    names = ("delay@duty", "lag@duty", "offset@v")
    (delay, gap), (lag, _), (offset, other) = (plant.sized(BUCK.effects[e], 2.0) for e in names)
    assert plant.beside(lag | offset, lag) == pytest.approx(other, rel=0.1)
    assert plant.beside(lag | delay, lag) < 0.5 * gap


def test_a_rival_may_have_the_other_sign():
    """Of a duty cycle that stays positive, a dead zone is a negative offset."""
    case = next(c for c in plan(1) if c.effects == ("dead_zone@duty",) and c.rig is BUCK)
    assert label(case, 1)["same"] == {"dead_zone@duty": ["offset@duty"]}


@pytest.mark.parametrize(
    ("model", "effect"), [("PneumaticCylinder", "stribeck@piston"), ("BallScrew", "stribeck@table")]
)
def test_friction_that_sticks_does_not_depend_on_the_plants_steps(model, effect):
    rig = BY_MODEL[model]
    factors = dict.fromkeys(rig.parameters, 1.0)
    sized, gap = SizedPlant(rig, factors).sized(rig.effects[effect], 8.0)
    finer = replace(rig.simulate, substeps=4 * rig.simulate.substeps)
    u = next(iter(rig.inputs.values()))
    one, other = (simulate(factors, sized, rig.time, u) for simulate in (rig.simulate, finer))
    assert gap > 7.0
    assert np.sqrt(np.mean(((one - other) / np.array(rig.noise)[:, None]) ** 2)) < 0.1


# ---- the grid ----


def test_the_first_so_many_cases_are_a_fair_sample_of_a_grid_that_seed_and_number_decide():
    grid = plan(5)
    assert grid == plan(5)
    assert grid != plan(6)
    cases = [c for c in grid if c.twin is None]
    assert len(cases) == 1000
    wanted = {"none": 0.3, "one": 0.35, "two": 0.1, "outside": 0.15, "held": 0.1}
    for some in (cases[:60], cases[:200], cases):
        strata = Counter(c.stratum for c in some)
        assert {s: n / len(some) for s, n in strata.items()} == pytest.approx(wanted, abs=1e-9)
        rigs = Counter(c.rig.model for c in some)
        assert max(rigs.values()) - min(rigs.values()) <= 5
    assert {c.recording.noise for c in cases} == set(NOISES)
    assert {c.recording.repeats for c in cases} == {1, 2, 3, 5}
    assert {c.twin for c in grid} == {None, "rate", "units", "idle"}
    assert all(e in c.rig.effects for c in cases for e in c.effects)


def test_a_twin_is_the_same_plant_with_the_same_information():
    grid = plan(5)
    for twin in (c for c in grid if c.twin is not None):
        own, how = grid[twin.drawn].recording, twin.recording
        assert how.quieter**2 / how.every == pytest.approx(own.quieter**2 / own.every)
        assert (how.every != own.every) is (twin.twin == "rate")
        assert how.other_units is (twin.twin == "units")
        assert (twin.rig, twin.effects, twin.gaps) == (
            grid[twin.drawn].rig,
            grid[twin.drawn].effects,
            grid[twin.drawn].gaps,
        )


def test_a_twin_at_another_rate_has_the_noise_of_its_case(tmp_path):
    """At half the rate each sample has the mean of two noises, so the information is the same."""
    short = replace(BUCK, inputs=dict(list(BUCK.inputs.items())[:1]))
    (u,) = short.inputs.values()
    clean = short.simulate(dict.fromkeys(short.parameters, 1.0), {}, short.time, u)
    noises = []
    for how in (Recording(1), Recording(1, every=2, quieter=2**0.5)):
        (tmp_path / f"{how.every}").mkdir()
        factors = dict.fromkeys(short.parameters, 1.0)
        (log,) = write_logs(short, factors, {}, tmp_path / f"{how.every}", how, np.random.default_rng(3))
        read = np.loadtxt(log, delimiter=",", skiprows=1).T[-len(clean) :]
        noises.append(read - clean[:, :: how.every])
    fast, slow = noises
    pairs = fast[:, : 2 * (fast.shape[1] // 2)].reshape(len(fast), -1, 2).mean(axis=2)
    sigma = np.asarray(short.noise)[:, None]
    assert slow[:, : pairs.shape[1]] / sigma == pytest.approx(pairs / sigma, abs=1e-4)
    assert np.std(slow / sigma) == pytest.approx(2**-0.5, rel=0.15)


def test_a_cases_folder_tells_what_a_user_has_and_no_more(tmp_path):
    case = next(c for c in plan(5) if c.rig is BUCK and c.stratum == "one" and c.recording.repeats == 2)
    truth = label(case, 5)
    assert truth["gap"] == pytest.approx(case.gaps[0], rel=0.06)
    write_case(case, truth, tmp_path / case.name, seed=5)
    order = json.loads((tmp_path / case.name / "order.json").read_text())
    assert set(order) == {"logs", "model", "class", "sigmas"}
    files = {f.name for f in (tmp_path / case.name).iterdir()}
    assert files == {"order.json", "BuckConverter.mo", *order["logs"]}
    assert len(order["logs"]) == 2 * len(BUCK.inputs)
    text = (tmp_path / case.name / order["logs"][0]).read_text()
    assert text.splitlines()[0] == "time [s],duty [1],v [V],i [A]"


@pytest.mark.parametrize("noise", NOISES)
def test_noise_is_of_its_kind_and_about_as_large_as_stated(tmp_path, noise):
    short = replace(BUCK, inputs={"sine": BUCK.inputs["sine"]})
    write_logs(short, {}, {}, tmp_path, Recording(3, noise), np.random.default_rng(0))
    plain = BUCK.simulate({}, {}, BUCK.time, BUCK.inputs["sine"])
    runs = []
    for k in range(3):
        with (tmp_path / f"sine_{k}.csv").open() as file:
            runs.append(np.array(list(csv.reader(file))[1:], dtype=float).T)
    errors = np.array([(r[2:] - plain) / np.array(BUCK.noise)[:, None] for r in runs])
    centred = errors - np.median(errors, axis=-1, keepdims=True)
    size = 1.4826 * np.median(np.abs(centred))
    assert 0.5 < size < 1.6
    assert (np.abs(centred).max() > 8) is np.True_ or noise != "spikes"
    same = all(np.array_equal(runs[0][1], r[1]) for r in runs)
    assert same is (noise != "inputs")
    correlation = np.mean(centred[..., 1:] * centred[..., :-1]) / np.mean(centred**2)
    assert (correlation > 0.7) is np.bool_(noise == "coloured") or noise in ("quantised", "drift")


# ---- the score ----


def case(
    kind: str,
    effects: list[str],
    verdict: str,
    sure: list[str] | None = None,
    one_of: list[list[str]] | None = None,
    *,
    gap: float = 4.0,
    probability: float = 0.9,
    free: tuple[str, ...] = (),
    same: dict[str, list[str]] | None = None,
    **more: object,
):
    sure, one_of = sure or [], one_of or []
    sets = [[*sure, *o] for o in one_of] or ([sure] if sure else [[{"complete": "none"}.get(verdict, "unknown")]])
    rest = [n for n in ("none", "unknown") if [n] not in sets]
    answer = {
        "verdict": {"kind": verdict, "effects": sure, "one_of": one_of, "ports": ["a"], "port": "a"},
        "answers": [
            {"effects": s, "probability": probability / len(sets), "closure": {"interval": [0.8, 1.0]}}
            for s in sets
        ]
        + [{"effects": [n], "probability": (1 - probability) / len(rest)} for n in rest],
        "effects": [{"id": "x@a", "probability": probability}],
        "gap": {"nominal_refit": gap, "corrected": 0.1},
        "free": list(free),
        "seconds": 3.0,
    }
    truth = {
        "case": "c", "rig": "r", "kind": kind, "effects": effects, "gaps": [gap] * len(effects),
        "gap": gap if effects else 0.0, "same": same or {}, "repeats": 3, "noise": "white", "sigma": False, "twin": None,
        **more,
    }  # fmt: skip
    return scored(truth, answer, 0.95)


CASES = (
    case("none", [], "complete"),
    case("none", [], "effect", ["x@a"]),
    case("one", ["x@a"], "effect", ["x@a"]),
    case("one", ["x@a"], "effect", ["y@b"], same={"x@a": ["y@b"]}),
    case("one", ["x@a"], "ambiguous", [], [["x@a"], ["y@b"]], same={"x@a": ["y@b"]}),
    case("one", ["x@a"], "ambiguous", [], [["x@a"], ["y@b"]]),
    case("one", ["x@a"], "ambiguous", [], [["z@b"], ["y@b"]]),
    case("one", ["x@a"], "partial", ["z@b"]),
    case("two", ["x@a", "y@b"], "effect", ["x@a", "y@b"]),
    case("two", ["x@a", "y@b"], "effect", ["x@a"], beside=[5.0, 3.0]),
    case("outside", ["chaos@a"], "unknown"),
    case("outside", ["chaos@b"], "unknown"),
    case("held", ["value@c"], "ambiguous", [], [["value@c"], ["x@a"]]),
    case("held", ["value@c"], "complete", free=("c",)),
    case("one", ["x@a"], "complete", repeats=1),
    case("none", [], "insufficient", repeats=1, sigma=True),
)


def outcome(cases=CASES, pairs=()):
    return Abroad(tuple(cases), tuple(pairs), len(cases), 1050, "0" * 64, {"rules": "abc"}, closed=True)


def test_every_figure_is_what_counting_by_hand_gives():
    found = {
        f.name: (f.value, f.count) for f in figures(outcome(pairs=[(CASES[0], CASES[0]), (CASES[0], CASES[1])]))
    }
    third = pytest.approx
    assert found == {
        "false alarm on complete models, R ≥ 2": (third(1 / 3), 3),  # the freed one is complete
        "R = 1, effect of 3 floors or more called complete": (1.0, 1),
        "exactly right, one effect, R ≥ 2": (0.5, 6),
        "a wrong effect named": (third(3 / 16), 16),
        "known effect called unknown or insufficient, R ≥ 2": (0.0, 9),
        "mean number of answers where ambiguous": (2.0, 3),
        "insufficient or ambiguous, R ≥ 2": (third(3 / 14), 14),
        "R = 1, noise bounded: complete called complete": (0.0, 1),
        "R = 1, noise bounded: power over that with R = 3": (third(0.0), 1),
        "unknown called unknown, R ≥ 2": (1.0, 2),
        "its port class right": (0.5, 2),
        "two effects: both, R ≥ 2": (0.5, 2),
        "wrong held parameter named, R ≥ 2": (1.0, 1),
        "held-out closure of right answers, median": (
            0.95,
            third(found["held-out closure of right answers, median"][1]),
        ),
        "held-out closure of right answers, 10th percentile": (
            0.95,
            found["held-out closure of right answers, median"][1],
        ),
        "90 % closure interval covers": (1.0, found["90 % closure interval covers"][1]),
        "median width of the closure interval": (third(0.2), found["90 % closure interval covers"][1]),
        "calibration error of the likeliest answer": (None, 16),
        "Brier score of all answers against a constant guess": (third(0.99824176), 16),
        "the same of the likeliest answer, right or wrong": (None, 16),
        "same information, same verdict": (0.5, 2),
    }


def test_equals_count_as_one_and_a_class_is_right_for_held_parameters_alone():
    assert [good(c) for c in CASES[2:6]] == [True, True, True, False]
    assert CASES[4].kind == "effect"
    assert in_class(CASES[5])
    assert not wrong(CASES[5])
    assert wrong(CASES[6])
    assert good(CASES[12])
    assert good(CASES[13])


def test_calibration_is_without_what_sampling_adds():
    rng = np.random.default_rng(1)
    honest, boastful = [], []
    for _ in range(600):
        p = float(rng.uniform(0.5, 1.0))
        right = bool(rng.random() < p)
        said = ["x@a"] if right else ["y@b"]
        honest.append(case("one", ["x@a"], "effect", said, probability=p))
        boastful.append(case("one", ["x@a"], "effect", said, probability=0.99))
    assert calibration(honest)[0] < 0.05
    assert calibration(boastful)[0] > 0.2
    assert calibration(honest)[1] < 1.0 < calibration(boastful)[1]


def test_probabilities_are_held_against_a_guess_that_knows_how_often_everything_is_true():
    right = case("one", ["x@a"], "effect", ["x@a"], probability=0.8)  # 0.2^2 + 2 times 0.1^2
    wrong_one = case("one", ["z@c"], "effect", ["x@a"], probability=0.8)  # 0.8^2 + 2 times 0.1^2 + 1
    guess = 1.0 - 0.5**2 - 0.5**2
    assert brier([right, wrong_one]) == pytest.approx((0.06 + 1.66) / 2 / guess)
    assert brier([right]) is None


def test_a_case_whose_effect_is_too_small_says_nothing_about_probabilities():
    clear = [case("one", ["x@a"], "effect", ["x@a"]), case("none", [], "complete")]
    faint = case("one", ["x@a"], "complete", gap=0.3)
    scores = [{f.name: f for f in figures(outcome(cases))} for cases in (clear, [*clear, faint])]
    name = "Brier score of all answers against a constant guess"
    assert scores[0][name] == scores[1][name]
    assert scores[0][name].count == 2
    assert brier(clear) != brier([*clear, faint])
    hidden = case("two", ["x@a", "y@b"], "effect", ["x@a"], beside=[5.0, 0.3])
    (both,) = (f for f in figures(outcome([*CASES, hidden])) if f.name == "two effects: both, R ≥ 2")
    assert (both.value, both.count) == (0.5, 2)


def test_the_page_names_every_case_that_is_not_right():
    text = page(outcome(), "make blind-abroad CASES=16", "## A note\n")
    missed = text.partition("## Every case that is not right")[2]
    assert missed.count("| c | r |") == sum(not good(c) for c in CASES)
    assert "| stratum | held | 1 | 1.00 | ambiguous 1 | 3 |" in text
    assert "## A note" in text
    assert same_verdict(CASES[3], CASES[4])


# ---- from end to end ----


def test_another_seed_than_the_frozen_one_is_refused(tmp_path):
    Check(tmp_path / "out", tmp_path / "labels", tmp_path / "frozen.json", seed=1).freeze()
    with pytest.raises(FmuidError, match="another than the one that was frozen"):
        Check(tmp_path / "out", tmp_path / "labels", tmp_path / "frozen.json", seed=2).freeze()


@pytest.mark.slow
def test_a_complete_model_is_called_complete_by_a_process_that_cannot_read_the_labels(tmp_path):
    rig = replace(BUCK, effects={}, outside=())
    check = Check(
        tmp_path / "out", tmp_path / "labels", tmp_path / "frozen.json", cases=1, seed=3, workers=1, rigs=[rig]
    )
    found = check.run()
    assert found.closed
    assert [c.kind for c in found.cases] == ["complete"]
    assert good(found.cases[0])
    again = check.run()  # nothing is made or diagnosed a second time
    assert again.cases == found.cases


@pytest.mark.slow
@pytest.mark.parametrize("rig", CHECKED_ON, ids=lambda rig: rig.model)
def test_model_and_plant_agree_to_well_under_the_noise_and_what_is_free_is_what_the_plant_varies(rig, tmp_path):
    rng = np.random.default_rng(3)
    logs = write_logs(rig, {}, {}, tmp_path, Recording(1), rng)
    model = ["--model", str(rig.file), "--class", rig.model]
    folder = tmp_path / "campaign"
    assert run(["init", *map(str, logs), *model, "--out", str(folder), "--workers", "0", "--quiet"]) == 0
    free = re.findall(r'^\[parameters\."(.*)"\]', (folder / "campaign.toml").read_text(), re.MULTILINE)
    assert set(free) == set(rig.parameters)
    factors = drawn_factors(rig, rng)
    values = [word for n, f in factors.items() for word in ("--set", f"{n}={f * rig.simulate.parameters[n]!r}")]
    out = tmp_path / "simulated"
    assert run(["simulate", str(folder), *values, "--out", str(out), "--workers", "0", "--quiet"]) == 0
    for name, u in rig.inputs.items():
        with (out / f"{name}_0.csv").open() as file:
            header, *rows = csv.reader(file)
        table = dict(zip([h.partition(" [")[0] for h in header], np.array(rows, dtype=float).T, strict=True))
        plant = rig.simulate(factors, {}, rig.time, u)
        for k, output in enumerate(rig.simulate.outputs):
            assert np.abs(table[output] - plant[k]).max() < 0.05 * rig.noise[k]
