"""A campaign through its stages, with models written inline."""

import dataclasses
import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from fmuid import (
    Campaign,
    CriterionSpec,
    Experiment,
    Measurements,
    Observer,
    ParameterSpec,
    Problem,
    Result,
    Signal,
    StageSpec,
    Status,
    identify,
    sensitivity_of,
    validate,
)
from fmuid.core.campaign import ModelSpec
from fmuid.core.errors import FmuError, ProblemError, UnitError
from fmuid.identification.uncertainty.sensitivity import excitation

TIME = np.linspace(0.0, 4.0, 201)
TRUTH = {"K": 0.7, "tau": 0.4, "offset@low": 0.3, "offset@high": -0.2}
NOISE = 0.01


def lag(time, inputs, p):
    """First-order lag of a held input, exactly; `scale` is a known setting."""
    y, out = 0.0, np.zeros(len(time))
    for k, step in enumerate(np.diff(time)):
        y += (p["scale"] * p["gain"] * inputs["u"][k] - y) * (1 - np.exp(-step / p["tau"]))
        out[k + 1] = y
    return {"y": out + p["bias"]}


def run(id, amplitude, offset, rng, repeat_of=None, *, unit="N.m", scale=2.0):
    u = amplitude * np.sign(np.sin(3 * TIME))
    exact = lag(TIME, {"u": u}, {"gain": 0.7, "tau": 0.4, "scale": scale, "bias": offset})["y"]
    y = exact + NOISE * rng.standard_normal(TIME.size)
    signals = {
        "current": Signal("current", 1000 * u, "mA", "input"),
        "torque": Signal("torque", y if unit == "N.m" else y * 1000, unit, "output"),
    }
    return Experiment(id, "bench", TIME, signals, {"scale": scale}, repeat_of=repeat_of)


def campaign(**changes):
    rng = np.random.default_rng(7)
    runs = [
        run("low", 1.0, 0.3, rng),
        run("low_2", 1.0, 0.3, rng, "low"),
        run("low_3", 1.0, 0.3, rng, "low"),
        run("high", 4.0, -0.2, rng, unit="mN.m", scale=1.0),
        run("held_out", 2.0, 0.0, rng, scale=3.0),
        run("held_out_2", 2.0, 0.0, rng, "held_out", scale=3.0),
    ]
    specs = [
        ParameterSpec("K", 0.5, 0.1, 2.0, unit="N.m/A", truth=0.7),
        ParameterSpec("tau", 100.0, 10.0, 5000.0, unit="ms", scale="log", truth=400.0),
        ParameterSpec("offset", 0.0, -1.0, 1.0, unit="N.m", per="experiment"),
    ]
    identification = ("low", "low_2", "low_3", "high")
    stages = [
        StageSpec("gain", ("low", "low_2", "low_3"), ("K", "offset"), start={"tau": 300.0}),
        StageSpec("all", identification, ("K", "tau", "offset")),
    ]
    names = {"current": "u", "torque": "y", "K": "gain", "offset": "bias"}
    plain = Campaign(
        name="lag",
        title="A lag",
        folder=Path(),
        measurements=Measurements({e.id: e for e in runs}),
        models={"bench": ModelSpec("bench", Path("lag.fmu"), names)},
        parameters={s.name: s for s in specs},
        settings={},
        stages={s.name: s for s in stages},
        identification=identification,
        validation=("held_out", "held_out_2"),
    )
    return dataclasses.replace(plain, **changes)


@pytest.fixture
def bench(analytic):
    units = {"y": "N.m", "u": "A", "tau": "s", "gain": "N.m/A", "bias": "N.m"}
    return {"bench": analytic(lag, ["gain", "tau", "scale", "bias"], units=units)}


def test_stages_find_the_truth_with_units_settings_and_offsets_of_single_runs(bench):
    result = identify(campaign(), simulators=bench)
    assert result.status is Status.CONVERGED
    assert result["K"].value == pytest.approx(0.7, rel=2e-3)
    assert result["tau"].value == pytest.approx(400.0, rel=1e-2)  # ms, as the campaign has it
    assert result["offset@low"].value == pytest.approx(0.3, abs=5e-3)
    assert result["offset@high"].value == pytest.approx(-0.2, abs=5e-3)
    for estimate in result.stage("all").estimates:
        truth = 400.0 if estimate.name == "tau" else TRUTH[estimate.name]
        assert abs(estimate.value - truth) < 4 * estimate.standard_error
    assert result["tau"].unit == "ms"
    assert result["K"].relative_error == pytest.approx(0.0, abs=2e-3)
    # The second stage starts where the first one ended.
    assert result.stage("all")["K"].start == result.stage("gain")["K"].value
    # Noise is known from the repeats of `low` alone, and also taken for that of `high`.
    assert [w.variance for w in result.stage("all").uncertainty.whiteness] == pytest.approx([1, 1], abs=0.3)


def test_repeats_share_one_simulation_and_weigh_as_if_compared_one_by_one(bench):
    stage = campaign().stages["gain"]
    together = Problem.of_stage(campaign(), stage, bench)
    assert len(together.cases) == 1
    assert together.cases[0].experiments == ("low", "low_2", "low_3")
    before = bench["bench"].count
    costs = [together.evaluate(together.space.start * f).cost for f in (1.0, 1.1)]
    assert bench["bench"].count == before + 2
    # One by one the cost is larger by the spread of the repeats, the same for every candidate.
    apart = 0.0
    channel = together.cases[0].channels[0]
    for f, sign in ((1.0, -1.0), (1.1, 1.0)):
        (prediction,) = together.evaluate(together.space.start * f).predictions
        apart += sign * np.sum(((prediction[0] - channel.repeats) / channel.noise.sigma) ** 2)
    assert costs[1] - costs[0] == pytest.approx(apart)


def test_nothing_is_simulated_twice(bench):
    problem = Problem.of_stage(campaign(), campaign().stages["all"], bench)
    x, before = problem.space.start, bench["bench"].count
    problem.evaluate_many([x, x, x])
    assert bench["bench"].count == before + 2  # two cases
    moved = x.copy()
    moved[problem.space.names.index("offset@high")] += 0.1
    problem.evaluate(moved)
    assert bench["bench"].count == before + 3  # the offset of one run concerns that run alone


def test_results_do_not_depend_on_where_simulations_run(bench):
    here = identify(campaign(), simulators=bench)
    with ThreadPoolExecutor(3) as pool:
        elsewhere = identify(campaign(), simulators=bench, executor=pool)
    assert elsewhere.parameters == here.parameters
    assert [s.cost for s in elsewhere.stages] == [s.cost for s in here.stages]


def test_a_result_survives_its_file_and_reads_well(tmp_path, bench):
    result = identify(campaign(), simulators=bench, out=tmp_path / "run")
    assert Result.from_json(tmp_path / "run") == result
    plain = json.loads((tmp_path / "run" / "result.json").read_text())
    assert plain["stages"][1]["estimates"][0]["truth"] == 0.7
    text = str(result)
    assert "converged" in text
    assert "offset@low" in text
    assert "N.m/A" in text
    assert "<table>" in result._repr_html_()


def test_validation_on_held_out_runs_reaches_the_noise(bench):
    result = identify(campaign(), simulators=bench)
    validation = validate(result, campaign(), simulators=bench)
    score = validation["held_out", "torque"]
    assert score.repeats == 2
    assert score.rmse == pytest.approx(NOISE, rel=0.1)
    assert score.noise_floor == pytest.approx(NOISE, rel=0.1)
    assert score.nrmse < 0.01
    wrong = validate({"K": 0.9, "tau": 400.0}, campaign(), simulators=bench)["held_out", "torque"]
    assert wrong.rmse > 20 * score.rmse
    assert "held_out" in str(validation)


def test_a_tie_makes_one_parameter_follow_another(bench):
    stage = StageSpec("tied", ("low",), ("tau", "offset"), tie={"K": "tau / 400 * 0.7"})
    result = identify(campaign(stages={"tied": stage}), simulators=bench)
    assert result["K"].value == pytest.approx(result["tau"].value / 400 * 0.7)
    assert result["tau"].value == pytest.approx(400, rel=0.01)


def test_sensor_offset_gain_and_delay_as_parameters(bench):
    changed = campaign()
    runs = dict(changed.measurements.experiments)
    low = runs["low"]
    late = np.interp(TIME - 0.05, TIME, low.signals["torque"].values)
    signals = {**low.signals, "torque": Signal("torque", 1.1 * late + 0.2, "N.m", "output", sigma=NOISE)}
    runs["low"] = dataclasses.replace(low, signals=signals)
    specs = {
        "tau": dataclasses.replace(changed.parameters["tau"], start=400.0, free=False),
        "K": dataclasses.replace(changed.parameters["K"], start=0.7, free=False),
        "offset": ParameterSpec("offset", 0.3),
        "s_gain": ParameterSpec("s_gain", 1.0),
        "s_offset": ParameterSpec("s_offset", 0.0),
        "s_delay": ParameterSpec("s_delay", 0.02, 0.0, 0.2),
    }
    sensor = {"gain": "s_gain", "offset": "s_offset", "delay": "s_delay"}
    criteria = (CriterionSpec("torque", options={"sensor": sensor}),)
    stage = StageSpec("sensor", ("low",), ("s_gain", "s_offset", "s_delay"), criteria=criteria)
    changed = dataclasses.replace(
        changed, measurements=Measurements(runs), parameters=specs, stages={"sensor": stage}
    )
    result = identify(changed, simulators=bench)
    assert result["s_gain"].value == pytest.approx(1.1, rel=0.01)
    assert result["s_offset"].value == pytest.approx(0.2, abs=0.01)
    assert result["s_delay"].value == pytest.approx(0.05, abs=0.005)
    # The sensor is the same where no criteria are given: in a validation, a simulation, a diagnosis.
    score = validate(result, changed, experiments=["low"], simulators=bench)["low", "torque"]
    assert score.rmse < 1.1 * NOISE


def test_missing_samples_do_not_count(bench):
    changed = campaign()
    runs = dict(changed.measurements.experiments)
    values = runs["low"].signals["torque"].values.copy()
    values[20:60] = np.nan
    signals = {**runs["low"].signals, "torque": Signal("torque", values, "N.m", "output", sigma=NOISE)}
    runs = {"low": dataclasses.replace(runs["low"], signals=signals)}
    stage = StageSpec("gappy", ("low",), ("K", "tau", "offset"))
    changed = dataclasses.replace(changed, measurements=Measurements(runs), stages={"gappy": stage})
    result = identify(changed, simulators=bench)
    assert result["K"].value == pytest.approx(0.7, rel=0.01)
    assert result.stages[0].uncertainty.whiteness[0].samples == TIME.size - 40


@pytest.mark.parametrize(
    ("stage", "error", "message"),
    [
        (StageSpec("s", ("low",), ("Q",)), ProblemError, "unknown parameter 'Q'"),
        (StageSpec("s", ("no_such",), ("K",)), ProblemError, "no experiment matches 'no_such'"),
        (StageSpec("s", ("low",), ("K",), criteria=(CriterionSpec("speed"),)), ProblemError, "'speed'"),
        (StageSpec("s", ("low",), ("K",), solver="bobyka"), ProblemError, "did you mean 'bobyqa'"),
        (StageSpec("s", ("low",), ("K",), combine="sum"), ProblemError, "unknown combine 'sum'"),
        (StageSpec("s", ("low",), ("K",), constraints=({"expression": "Q", "max": 1},)), ProblemError, "'Q'"),
        (StageSpec("s", ("low",), ("K",), constraints=({"expression": "K"},)), ProblemError, "not understood"),
    ],
)
def test_stages_that_cannot_be_posed(tmp_path, bench, stage, error, message):
    stages = {"gain": campaign().stages["gain"], "s": stage}
    with pytest.raises(error, match=message):
        identify(campaign(stages=stages), simulators=bench, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()
    assert bench["bench"].count == 0


def test_names_and_units_that_do_not_fit_the_model(bench, analytic):
    model = campaign().models["bench"]
    unmapped = dataclasses.replace(model, map={**model.map, "torque": "moment"})
    with pytest.raises(FmuError, match=r"lag.fmu has no variable 'moment' for 'torque'"):
        identify(campaign(models={"bench": unmapped}), simulators=bench)
    speed = {"bench": analytic(lag, ["gain", "tau", "scale", "bias"], units={"y": "rad/s", "u": "A"})}
    with pytest.raises(UnitError, match="signal 'torque' of experiment 'low'"):
        identify(campaign(), simulators=speed)


def test_progress_is_told_in_order(bench):
    class Notes(Observer):
        def __init__(self):
            self.lines = []

        def started(self, problem, solver, why, stop):
            self.lines.append(f"start {problem.name} {solver}")

        def evaluated(self, progress):
            self.lines.append(progress)

        def finished(self, result):
            self.lines.append(f"end {result.name}")

    notes = Notes()
    identify(campaign(), simulators=bench, observer=notes, with_uncertainty=False)
    words = [line for line in notes.lines if isinstance(line, str)]
    assert words == ["start gain trf", "end gain", "start all trf", "end all"]
    costs = [line.cost for line in notes.lines if not isinstance(line, str)]
    assert costs[-1] < 1e-3 * costs[0]


def test_linear_algebra_takes_one_thread_and_gives_them_back(bench):
    def threads():
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    class Threads(Observer):
        def evaluated(self, progress):
            seen.update(threads())

    seen = set()
    with threadpool_limits(2, user_api="blas"):
        identify(campaign(), simulators=bench, observer=Threads(), with_uncertainty=False)
        assert (seen, threads()) == ({1}, {2})


def test_sensitivity_names_dead_parameters_and_the_noise_floor(bench, analytic):
    problem = Problem.of_stage(campaign(), campaign().stages["all"], bench)
    sensitivity = sensitivity_of(problem)
    assert sensitivity.dead == ()
    assert sensitivity.floor.relative < 1e-12
    # 1 % of K moves the torque by about 1 %, that is 0.01 * 0.5 * 2 / 0.01 sigma * sqrt(3) repeats = 1.7 sigma.
    assert sensitivity.effect[0, 0] == pytest.approx(1.7, rel=0.2)
    ignoring = analytic(lambda t, u, p: lag(t, u, {**p, "tau": 0.4}), ["gain", "tau", "scale", "bias"])
    deaf = sensitivity_of(Problem.of_stage(campaign(), campaign().stages["all"], {"bench": ignoring}))
    assert deaf.dead == ("tau",)
    assert "tau: no effect" in str(deaf) or "tau" in deaf.identifiability.undetermined


def test_excitation_says_what_no_run_shows():
    time = np.linspace(0, 1, 101)

    def moving(speed, load):
        signals = {
            "w": Signal("w", speed, "rad/s", "output"),
            "T": Signal("T", load, "N.m", "output"),
            "u": Signal("u", speed, "A", "input"),
        }
        runs = Measurements({"a": Experiment("a", "bench", time, signals)})
        return excitation(campaign(measurements=runs, identification=("a",)))

    swing = np.sin(2 * np.pi * time)
    assert any("no run reverses direction:" in line for line in moving(1 + 0.5 * swing, np.ones(101)))
    assert any("reverses direction under load" in line for line in moving(swing, swing))
    assert moving(swing, np.cos(2 * np.pi * time)) == ()


def test_a_campaign_interrupted_in_its_second_stage_goes_on_there(tmp_path, bench):
    whole = identify(campaign(), simulators=bench)

    class Interrupt(Observer):
        def evaluated(self, progress):
            if progress.stage == "all" and progress.evaluations == 4:
                raise KeyboardInterrupt

    stopped = identify(campaign(), simulators=bench, out=tmp_path, observer=Interrupt())
    assert [s.status for s in stopped.stages] == [Status.CONVERGED, Status.INTERRUPTED]
    before = bench["bench"].count
    resumed = identify(campaign(), simulators=bench, out=tmp_path, resume=True)
    assert resumed.parameters == whole.parameters
    # The first stage is not simulated again: two cases for each evaluation of the second are the most.
    stage = resumed.stage("all")
    assert bench["bench"].count - before <= 2 * (stage.evaluations + 2 * len(stage.estimates) + 7)
    assert resumed.stage("gain") == stopped.stage("gain")
    assert resumed.status is Status.CONVERGED


def test_lazy_public_names_all_load():
    import fmuid

    assert all(callable(getattr(fmuid, name)) for name in dir(fmuid))
