"""campaign.toml: read into values, or refused in one line that says what, where and what to do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fmuid.campaigns.campaign_toml import load_campaign
from fmuid.core.errors import CampaignError, FmuidError

REMOVE = object()


def test_values(folder: Path) -> None:
    campaign = load_campaign(folder)
    assert (campaign.name, campaign.title) == ("bench", "bench")
    assert campaign.models["fixed_shaft"].fmu == folder / "FixedShaft.fmu"
    assert campaign.models["fixed_shaft"].variable("tau") == "tau_sensor"
    assert campaign.models["free_shaft"].initial == {"phi": 0.1}
    damping, inertia, *_ = campaign.parameters.values()
    assert (damping.start, damping.lower, damping.upper, damping.unit) == (0.6, 0.1, 10.0, "N.m.s/rad")
    assert (inertia.scale, inertia.truth, inertia.free) == ("log", 0.00304, True)
    assert campaign.settings == {"c_S": 130000.0, "load.J": 0.5}
    assert campaign.published == {"M": 95.1}


def test_globs_bring_repeats_along(folder: Path) -> None:
    campaign = load_campaign(folder / "campaign.toml")
    assert campaign.identification == ("step_1", "step_1_r1", "step_2", "free")
    assert campaign.validation == ("prbs",)
    assert campaign.stages["linear"].experiments == ("step_1", "step_1_r1", "step_2")


def test_stages(folder: Path) -> None:
    linear, table = load_campaign(folder).stages.values()
    assert linear.free == ("d_S", "J_S")
    assert linear.start == {"d_S": 0.7}
    (criterion,) = linear.criteria
    assert (criterion.signal, criterion.kind, criterion.demand) == ("tau", "least_squares", 0.5)
    assert (criterion.start_time, criterion.stop_time) == (0.1, np.inf)
    assert (linear.solver, linear.solver_options) == ("bobyqa", {"tolerance": 1e-6})
    assert (linear.max_evaluations, linear.max_seconds) == (400, 60.0)
    assert table.tie == {"lossTable[2,5]": "0.9*lossTable[2,4] + J_S"}
    assert table.solver == "auto"


def test_what_is_not_said(folder: Path) -> None:
    edit(folder, {"[roles]\n": "", 'identification = ["step_*", "free"]\n': "", 'validation = ["prbs"]\n': "",
                  'experiments = ["free"]\nfree = ["lossTable[2,4]"]': 'experiments = ["free"]',
                  'make = "make bench-data"\n': "", 'name = "bench"\n': ""})  # fmt: skip
    campaign = load_campaign(folder)
    assert campaign.name == "bench"
    assert campaign.identification == ("step_1", "step_1_r1", "step_2", "prbs", "free")
    assert campaign.validation == ()
    assert campaign.stages["table"].free == ("d_S", "J_S")


def test_a_repeat_may_be_kept_for_validation(folder: Path) -> None:
    edit(folder, {'validation = ["prbs"]': 'validation = ["prbs", "step_1_r1"]'})
    campaign = load_campaign(folder)
    assert campaign.identification == ("step_1", "step_2", "free")
    assert campaign.validation == ("step_1_r1", "prbs")
    assert campaign.stages["linear"].experiments == ("step_1", "step_2")


def edit(folder: Path, changes: dict[str, str]) -> None:
    file = folder / "campaign.toml"
    text = file.read_text()
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    file.write_text(text)


# name: (text of the right file, what it becomes), line
WRONG: dict[str, tuple[str, str, str]] = {
    "syntax": (
        "start = 0.003",
        "start = 0,003",
        "campaign.toml line 20: is not TOML: expected newline or end of document after a statement; correct the line",
    ),
    "syntax_string": (
        'name = "bench"',
        'name = "bench',
        "campaign.toml line 2: is not TOML: illegal character '\\n'; correct the line",
    ),
    "twice": (
        "[parameters.J_S]",
        "[parameters.d_S]",
        "campaign.toml line 19: is not TOML: cannot declare ('parameters', 'd_S') twice; correct the line",
    ),
    "unfinished": (
        "M = 95.1\n",
        "M = [95.1",
        "campaign.toml at its end: is not TOML: unclosed array; correct the line",
    ),
    "unknown_table": (
        "[settings]",
        "[seting]",
        "campaign.toml: unknown key 'seting'; did you mean 'settings'?",
    ),
    "unknown_key": (
        "lower = 0.1",
        "lowr = 0.1",
        "campaign.toml [parameters.d_S]: unknown key 'lowr'; did you mean 'lower'?",
    ),
    "unknown_head_key": (
        'name = "bench"',
        'nmae = "bench"',
        "campaign.toml [campaign]: unknown key 'nmae'; did you mean 'name'?",
    ),
    "unknown_model_key": (
        "initial = {",
        "inital = {",
        "campaign.toml [models.free_shaft]: unknown key 'inital'; did you mean 'initial'?",
    ),
    "unknown_stage_key": (
        "solver = {",
        "slover = {",
        "campaign.toml [stages.linear]: unknown key 'slover'; did you mean 'solver'?",
    ),
    "unknown_budget_key": (
        "seconds = 60",
        "second = 60",
        "campaign.toml [stages.linear] budget: unknown key 'second'; did you mean 'seconds'?",
    ),
    "unknown_criterion_key": (
        "demand = 0.5",
        "demnd = 0.5",
        "campaign.toml [stages.linear] criterion 1: unknown key 'demnd'; did you mean 'demand'?",
    ),
    "start_is_text": (
        "start = 0.6",
        'start = "0.6"',
        "campaign.toml [parameters.d_S]: 'start' is text; write a number",
    ),
    "start_is_true": (
        "start = 0.6",
        "start = true",
        "campaign.toml [parameters.d_S]: 'start' is true or false; write a number",
    ),
    "no_start": (
        "start = 0.6\n",
        "",
        "campaign.toml [parameters.d_S]: has no 'start'; write start = ...",
    ),
    "no_fmu": (
        'fmu = "FixedShaft.fmu"\n',
        "",
        'campaign.toml [models.fixed_shaft]: has no \'fmu\'; write fmu = "file", source = "file.mo", or fmus = { name = "file", ... }',
    ),
    "fmu_empty": (
        'fmu = "FixedShaft.fmu"',
        'fmu = ""',
        'campaign.toml [models.fixed_shaft]: has no \'fmu\'; write fmu = "file", source = "file.mo", or fmus = { name = "file", ... }',
    ),
    "fmu_is_list": (
        'fmu = "FixedShaft.fmu"',
        'fmu = ["FixedShaft.fmu"]',
        "campaign.toml [models.fixed_shaft]: 'fmu' is a list; write text",
    ),
    "start_is_nan": (
        "start = 0.6",
        "start = nan",
        "campaign.toml [parameters.d_S]: 'start' is nan; write a finite number",
    ),
    "bounds_reversed": (
        "upper = 10",
        "upper = 0.01",
        "campaign.toml [parameters.d_S]: lower 0.1 is not below upper 0.01; swap them, or set free = false to keep it constant",
    ),
    "bound_is_nan": (
        "upper = 10",
        "upper = nan",
        "campaign.toml [parameters.d_S]: a bound is nan; write a number, or leave the bound out",
    ),
    "start_outside": (
        "start = 0.6",
        "start = 60",
        "campaign.toml [parameters.d_S]: start 60 is outside [0.1, 10]; move the start or the bounds",
    ),
    "log_of_zero": (
        "lower = 1e-4",
        "lower = 0",
        "campaign.toml [parameters.J_S]: scale is log but lower is 0; give lower > 0, or scale = 'linear'",
    ),
    "log_without_lower": (
        "lower = 1e-4\n",
        "",
        "campaign.toml [parameters.J_S]: scale is log without lower; give lower > 0",
    ),
    "scale": (
        'scale = "log"',
        'scale = "logarithm"',
        "campaign.toml [parameters.J_S]: 'scale' is 'logarithm'; known: linear, log",
    ),
    "dotted_parameter": (
        "[parameters.J_S]",
        "[parameters.load.J]",
        "campaign.toml [parameters.load]: has no 'start'; a name with dots needs quotes, as in [parameters.\"load.J\"]",
    ),
    "no_model": (
        "[models.free_shaft]",
        "[models.fre_shaft]",
        "campaign.toml [models]: no model for setup 'free_shaft' of experiment 'free'; did you mean 'fre_shaft'?",
    ),
    "map_of_nothing": (
        "map = { tau =",
        "map = { tua =",
        "campaign.toml [models.fixed_shaft] map: 'tua' is not a signal, setting or parameter; did you mean 'tau'?",
    ),
    "map_to_number": (
        'map = { tau = "tau_sensor" }',
        "map = { tau = 3 }",
        "campaign.toml [models.fixed_shaft]: a value in 'map' is a whole number; write text",
    ),
    "initial_is_text": (
        "phi = 0.1",
        'phi = "0.1"',
        "campaign.toml [models.free_shaft] initial: 'phi' is not a number; write a number",
    ),
    "setting_is_text": (
        "c_S = 130000",
        'c_S = "130000"',
        "campaign.toml [settings]: 'c_S' is not a number; write a number",
    ),
    "setting_and_parameter": (
        "c_S = 130000",
        "d_S = 1",
        "campaign.toml [settings]: 'd_S' is also a parameter; give it in one of the two tables",
    ),
    "setting_of_a_run_and_parameter": (
        "[parameters.d_S]",
        "[parameters.mgr]",
        "campaign.toml [parameters.mgr]: 'mgr' is set by experiment 'free'; a value that the run sets cannot be a parameter: remove one of the two",
    ),
    "unknown_experiment": (
        'validation = ["prbs"]',
        'validation = ["prsb"]',
        "campaign.toml [roles] validation: 'prsb' is not an experiment; did you mean 'prbs'?",
    ),
    "glob_of_nothing": (
        'validation = ["prbs"]',
        'validation = ["sine_*"]',
        "campaign.toml [roles] validation: 'sine_*' matches no experiment; known: step_1, step_2, prbs, free",
    ),
    "both_roles": (
        'validation = ["prbs"]',
        'validation = ["prbs", "free"]',
        "campaign.toml [roles]: 'free' is both in identification and in validation; validate on runs that are not used",
    ),
    "stage_on_validation": (
        'experiments = ["free"]',
        'experiments = ["prbs"]',
        "campaign.toml [stages.table] experiments: 'prbs' is not in the identification set; see [roles] in the same file",
    ),
    "stage_without_runs": (
        'experiments = ["free"]',
        "experiments = []",
        "campaign.toml [stages.table]: has no experiments; name experiments of the identification set",
    ),
    "experiments_is_text": (
        'experiments = ["free"]',
        'experiments = "free"',
        "campaign.toml [stages.table]: 'experiments' is text; write a list",
    ),
    "unknown_free": (
        'free = ["d_S", "J_S"]',
        'free = ["d_s", "J_S"]',
        "campaign.toml [stages.linear] free: unknown parameter 'd_s'; did you mean 'd_S'?",
    ),
    "frees_nothing": (
        'free = ["d_S", "J_S"]',
        "free = []",
        'campaign.toml [stages.linear]: has no free parameter; write free = ["..."]',
    ),
    "unknown_start": (
        "start = { d_S = 0.7 }",
        "start = { d_G = 0.7 }",
        "campaign.toml [stages.linear] start: unknown parameter 'd_G'; did you mean 'd_S'?",
    ),
    "stage_start_outside": (
        "start = { d_S = 0.7 }",
        "start = { d_S = 70 }",
        "campaign.toml [stages.linear]: start 70 of 'd_S' is outside [0.1, 10]; move the start or the bounds",
    ),
    "unknown_follower": (
        'tie = { "lossTable[2,5]"',
        'tie = { "lossTable[3,5]"',
        "campaign.toml [stages.table] tie: unknown parameter 'lossTable[3,5]'; did you mean 'lossTable[2,5]'?",
    ),
    "unknown_leader": (
        "0.9*lossTable[2,4] + J_S",
        "0.9*lossTable[2,4] + J_R",
        "campaign.toml [stages.table] tie: unknown parameter 'J_R'; did you mean 'J_S'?",
    ),
    "no_expression": (
        "0.9*lossTable[2,4] + J_S",
        "open(1)",
        "campaign.toml [stages.table] tie: 'open(1)' is not an arithmetic expression; use numbers, parameters, + - * / ** and abs, cos, exp, log, max, min, sin, sqrt, tan, tanh",
    ),
    "circle": (
        "0.9*lossTable[2,4] + J_S",
        "2*lossTable[2,5]",
        "campaign.toml [stages.table] tie: circular ties: lossTable[2,5] -> lossTable[2,5]; break the circle",
    ),
    "free_and_tied": (
        'free = ["lossTable[2,4]"]',
        'free = ["lossTable[2,4]", "lossTable[2,5]"]',
        "campaign.toml [stages.table] tie: 'lossTable[2,5]' is both free and tied; remove it from one of the two",
    ),
    "unknown_signal": (
        'signal = "tau"',
        'signal = "tau_sensor"',
        "campaign.toml [stages.linear] criterion 1: signal 'tau_sensor' is not measured in these experiments; known: tau, w_motor",
    ),
    "demand_interval": (
        "demand = 0.5",
        "demand = [2.0, 0.5]",
        "campaign.toml [stages.linear] criterion 1: demand is [2, 0.5]; write [good, bad], such as [0.5, 2.0]",
    ),
    "demand_zero": (
        "demand = 0.5",
        "demand = 0",
        "campaign.toml [stages.linear] criterion 1: demand is 0; write a positive number",
    ),
    "times_reversed": (
        "from = 0.1",
        "from = 0.1, to = 0.05",
        "campaign.toml [stages.linear] criterion 1: 'from' (0.1) is not before 'to' (0.05); swap them",
    ),
    "solver_without_name": (
        'name = "bobyqa", ',
        "",
        'campaign.toml [stages.linear]: solver has no name; write solver = { name = "bobyqa", ... }',
    ),
    "solver_is_number": (
        'solver = { name = "bobyqa", tolerance = 1e-6 }',
        "solver = 3",
        "campaign.toml [stages.linear]: 'solver' is a whole number; write text or a table",
    ),
    "budget_zero": (
        "evaluations = 400",
        "evaluations = 0",
        "campaign.toml [stages.linear]: budget evaluations is 0; write a positive number",
    ),
    "budget_fraction": (
        "evaluations = 400",
        "evaluations = 400.5",
        "campaign.toml [stages.linear] budget: 'evaluations' is a number; write a whole number",
    ),
    "no_measurements": (
        'name = "bench"',
        'name = "bench"\nmeasurements = "measured.h5"',
        "measured.h5: no such file; make it with: make bench-data",
    ),
    "no_measurements_no_way": (
        'make = "make bench-data"',
        'measurements = "measured.h5"',
        "measured.h5: no such file; check the path",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_mistake_is_one_clear_line(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    old, new, line = WRONG[name]
    edit(folder, {old: new})
    with pytest.raises(FmuidError) as error:
        load_campaign("campaign.toml")
    assert str(error.value) == line


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (None, "bench/campaign.toml: no such file; give a folder with a campaign.toml, or make one with: fmuid init"),
        (b"\xff\xfe", "bench/campaign.toml: is not UTF-8 text; save it as UTF-8"),
        (b"x = " + b"[" * 5000, "bench/campaign.toml: is nested too deeply; flatten it"),
        (b"x = 1e400\n", "bench/campaign.toml: unknown key 'x'; known: campaign, signals, models, parameters, settings, stages, roles, effects, limits, design, robot, published"),
        (b"settings = 3", "bench/campaign.toml: 'settings' is a whole number; write a table"),
    ],
)  # fmt: skip
def test_no_campaign_file(content: bytes | None, line: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder.parent)
    file = folder / "campaign.toml"
    if content is None:
        file.unlink()
    else:
        file.write_bytes(content)
    with pytest.raises(CampaignError) as error:
        load_campaign("bench")
    assert str(error.value) == line


VALUES = st.recursive(
    st.sampled_from(["1", "-0.5", "nan", "inf", "true", '"step_*"', '"d_S"', '"log"', '"2*d_S"', "1979-05-27", "[]", "{}", "9" * 400]),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3).map(lambda v: f"[{', '.join(v)}]"),
        st.dictionaries(st.sampled_from(["start", "name", "signal", "d_S", "x"]), inner, max_size=3).map(
            lambda d: "{" + ", ".join(f"{k} = {v}" for k, v in d.items()) + "}"
        ),
    ),
    max_leaves=5,
)  # fmt: skip


@settings(
    derandomize=True,
    max_examples=200,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    database=None,
)
@given(data=st.data())
def test_no_value_of_any_key_gives_a_traceback(folder: Path, data: st.DataObject) -> None:
    right = (
        (Path(__file__).parent / "conftest.py").read_text().split('TOML = """\\\n')[1].split('"""')[0].splitlines()
    )
    keys = [i for i, line in enumerate(right) if " = " in line]
    line = data.draw(st.sampled_from(keys))
    right[line] = f"{right[line].split(' = ')[0]} = {data.draw(VALUES)}"
    (folder / "campaign.toml").write_text("\n".join(right))
    try:
        load_campaign(folder)
    except FmuidError as error:
        complaint = str(error)
    else:
        return
    assert complaint.startswith(str(folder))
    assert "\n" not in complaint


@settings(
    derandomize=True,
    max_examples=100,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    database=None,
)
@given(
    content=st.one_of(
        st.binary(max_size=60),
        st.text(max_size=60).map(str.encode),
        st.text("[]{}=\"'.\n#ab1", max_size=60).map(str.encode),
    )
)
def test_no_content_gives_a_traceback(folder: Path, content: bytes) -> None:
    (folder / "campaign.toml").write_bytes(content)
    try:
        load_campaign(folder)
    except CampaignError as error:
        complaint = str(error)
    else:
        return
    assert "\n" not in complaint
