"""The blind check: its figures on answers that are known, what keeps the labels away, and a few real cases."""

import hashlib
import json
import os
import stat
from pathlib import Path

import pytest

from benchmarks.blind.blind_check import Check, _environment, checked_labels, main, out_of_reach
from benchmarks.blind.blind_page import page
from benchmarks.blind.blind_score import Outcome, Scored, calibration, confusion, figures, power_curve, share
from benchmarks.virtual_rig.blind_cases import find_truth, plan_cases, record_case
from benchmarks.virtual_rig.blind_experiments import sealed_experiments
from benchmarks.virtual_rig.blind_further import add_suggested_run
from fmuid.core.errors import FmuidError
from fmuid.data.measurements import read_measurements, write_measurements

ROOT = Path(__file__).parents[2]
PORTS = ("friction", "sensor")


def scored(
    kind: str,
    effects: list[str],
    verdict: str,
    named: list[str] | None = None,
    *,
    gaps: list[float] | None = None,
    encoder: bool = True,
    port: str | None = "friction",
    probability: dict[str, float] | None = None,
    **options: object,
) -> Scored:
    gaps = [3.0] * len(effects) if gaps is None else gaps
    named = named or []
    head = named or [{"complete": "none"}.get(verdict, "unknown")]
    each = 1.0 / len(head) if verdict == "ambiguous" else 1.0
    given = probability or dict.fromkeys(head, each)
    label = {
        "case": "c",
        "kind": kind,
        "effects": effects,
        "ports": ["friction"] * len(effects),
        "gaps": gaps,
        "gap": max(gaps, default=0.0),
        "noise": "usual",
        "repeats": 6,
        "load_encoder": encoder,
    }
    closure = {"train": 1, "held_out": 0.9, "interval": [0.8, 1]}
    sure = [] if verdict == "ambiguous" else named
    one_of = [[n] for n in named] if verdict == "ambiguous" else []
    sets = [[n] for n in named] if verdict == "ambiguous" else [named] if named else []
    answer = {
        "verdict": {
            "kind": verdict,
            "effects": sure,
            "one_of": one_of,
            "port": port,
            "ports": [] if port is None else [port],
        },
        "answers": [
            {"effects": s, "probability": min(given.get(n, 0.0) for n in s), "closure": closure} for s in sets
        ]
        + [{"effects": [n], "probability": given.get(n, 0.0)} for n in ("none", "unknown")],
        "gap": {"nominal_refit": 3.0, "corrected": 0.1},
        "effects": [{"id": n, "probability": given.get(n, 0.0), "closure": closure} for n in ("a", "b")],
        "baselines": {"white_noise_bic": ["a"], "hold_out_rmse": [], "score_without_projection": ["b"]},
    }
    return Scored(label, answer, **options)


CASES = (
    scored("none", [], "complete"),
    scored("none", [], "effect", ["a"]),
    scored("one", ["a"], "effect", ["a"], closure=0.9),
    scored("one", ["a"], "effect", ["b"], closure=0.4),
    scored("one", ["a"], "complete", gaps=[0.5]),
    scored("one", ["b"], "ambiguous", ["a", "b"], encoder=False, closure=0.7, second=None),
    scored("one", ["b"], "unknown", encoder=False, port="sensor"),
    scored("two", ["a", "b"], "effect", ["a", "b"], closure=0.7),
    scored("two", ["a", "b"], "effect", ["a"]),
    scored("outside", ["rub"], "unknown"),
    scored("outside", ["rub"], "effect", ["b"], port="sensor"),
)


def test_every_figure_of_the_aims_table_is_what_counting_by_hand_gives():
    found = {f.name: (f.value, f.count) for f in figures(CASES, PORTS)}
    assert found == {
        "false alarm on complete models": (0.5, 2),
        "top-1, load encoder": (0.5, 2),
        "top-2, load encoder": (pytest.approx(0.5, abs=0.5), 2),  # the others tie at zero
        "top-1, no load encoder": (pytest.approx(0.25, abs=0.25), 2),
        "class coverage, no load encoder": (0.5, 2),
        "mean class size, no load encoder": (2.0, 1),
        "unknown called unknown": (0.5, 2),
        "known called unknown": (pytest.approx(1 / 6), 6),
        "two effects: both": (0.5, 2),
        "two effects: at least one": (1.0, 2),
        "right port": (pytest.approx(4 / 6), 6),
        "held-out closure, median": (pytest.approx(0.8), 2),
        "held-out closure, 10th percentile": (pytest.approx(0.72), 2),
        "90 % closure interval covers": (0.5, 2),
        "calibration error (ECE)": (pytest.approx(found["calibration error (ECE)"][0]), len(CASES)),
        "Brier score": (pytest.approx(found["Brier score"][0]), len(CASES)),
        "suggested experiment settles": (None, 0),
    }


def test_calibration_is_of_the_verdict_and_brier_of_every_probability():
    right = scored("one", ["a"], "effect", ["a"], probability={"a": 0.8, "b": 0.2})
    wrong = scored("one", ["b"], "effect", ["a"], probability={"a": 0.8, "b": 0.2})
    assert calibration([right] * 4 + [wrong]) == pytest.approx((0.0, 0.8 * 0.08 + 0.2 * 1.28))
    assert calibration([wrong]) == pytest.approx((0.8, 1.28))
    both = scored("two", ["a", "b"], "effect", ["a", "b"])
    assert calibration([both]) == pytest.approx((0.0, 0.0))


def test_a_suggested_experiment_settles_only_what_ends_with_the_truth_alone():
    first = scored("one", ["a"], "ambiguous", ["a", "b"])
    for named, settled in ((["a"], 1.0), (["b"], 0.0)):
        case = Scored(first.label, first.answer, 0.9, scored("one", ["a"], "effect", named).answer)
        figure = next(f for f in figures([case], PORTS) if f.name == "suggested experiment settles")
        assert (figure.value, figure.count) == (settled, 1)


def test_shares_say_how_sure_they_are_and_by_how_much_they_miss():
    figure = share("of ten", [True] * 8 + [False] * 2, lower=0.9)
    assert figure.missed_by == pytest.approx(0.1)
    assert figure.interval == pytest.approx((0.5408, 0.9314), abs=1e-4)
    assert share("of none", []).value is None


def test_power_and_confusion_count_every_case_once():
    assert [(p.count, p.detected, p.right) for p in power_curve(CASES)] == [(1, 0.0, 0.0), (4, 1.0, 0.25)]
    table = confusion(CASES)
    assert sum(n for given in table.values() for n in given.values()) == len(CASES)
    assert table["b"] == {"a or b": 1, "unknown": 1}
    assert table["outside: rub"] == {"unknown": 1, "b": 1}


def test_the_page_has_the_command_the_hash_the_misses_and_the_failures():
    notes = (ROOT / "docs" / "blind_notes.md").read_text()
    text = page(Outcome(CASES, PORTS, 12, 200, 5, "abc123", closed=True), "make blind COUNT=200", notes)
    for piece in ("make blind COUNT=200", "abc123", "11 of 12 cases", "| not measured |", "by 0.45", "a or b"):
        assert piece in text
    assert "white-noise BIC" in text
    assert notes in text
    headings = [line for line in text.splitlines() if line.startswith("#")]
    assert headings[1:4] == ["## What was known beforehand", "## Which code", "## Why aims are missed"]
    failures = text.split("## Every case")[1]
    assert failures.count("\n| c |") == sum(not c.right for c in CASES)


def test_the_labels_folder_is_closed_meanwhile_and_open_again_even_after_an_error(tmp_path):
    tmp_path.chmod(0o700)

    def look() -> None:
        with out_of_reach(tmp_path) as closed:
            assert stat.S_IMODE(tmp_path.stat().st_mode) == 0
            assert closed  # a superuser's check diagnoses as a user without rights
            raise RuntimeError

    with pytest.raises(RuntimeError):
        look()
    assert stat.S_IMODE(tmp_path.stat().st_mode) == 0o700


def test_the_environment_of_the_diagnosing_process_tells_neither_labels_nor_seed(monkeypatch):
    told = {"LABELS": "x", "SEED": "5", "MAKEFLAGS": "-- SEED=5", "OTHER": "/some/where/blind-labels/c1"}
    for name, value in told.items():
        monkeypatch.setenv(name, value)
    left = _environment(Path("../blind-labels"))
    assert not told.keys() & left.keys()
    assert left["PATH"] == os.environ["PATH"]


def test_labels_inside_the_working_folder_are_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["--labels", "here/labels"]) == 2
    assert "elsewhere" in capsys.readouterr().err


def test_labels_that_are_not_those_of_the_hash_are_refused(tmp_path):
    (tmp_path / "labels.json").write_text(json.dumps([]))
    digest = tmp_path / "labels.sha256"
    digest.write_text("0" * 64 + "  labels.json\n")
    with pytest.raises(FmuidError, match="hash"):
        checked_labels(tmp_path, digest)


def test_the_suggested_run_is_made_on_the_case_s_own_actuator_and_repeated_as_often(tmp_path):
    case = next(c for c in plan_cases(4, 1) if c.kind == "none")
    truth = find_truth(case)
    first = tuple(e for e in sealed_experiments() if e.id == "step_0p5")
    write_measurements(record_case(truth, first, "campaign"), tmp_path / "before.h5")
    target = tmp_path / "second" / "measurements.h5"
    add_suggested_run(truth, "as step_0p5, with its input times -0.5", tmp_path / "before.h5", target)
    both = read_measurements(target)
    assert len(both.experiments) == 2 * case.repeats
    assert len(both.repeats("step_0p5_further")) == case.repeats
    before, further = (both[n].signals["i_cmd"].values for n in ("step_0p5", "step_0p5_further"))
    assert further == pytest.approx(-0.5 * before)
    with pytest.raises(FmuidError, match="virtual rig"):
        add_suggested_run(truth, "as nothing, with its input times 2", tmp_path / "before.h5", target)


@pytest.mark.slow
def test_an_open_answer_is_asked_again_with_the_run_it_suggested_and_nothing_is_done_twice(tmp_path, monkeypatch):
    rounds = []

    def diagnose(check: Check, campaigns: Path, answers: Path) -> bool:
        """Stand for the diagnosing process."""
        rounds.append(campaigns.name)
        for case in campaigns.glob("*/measurements.h5"):
            further = "step_0p5_further" in read_measurements(case).experiments
            answer = dict(
                scored("one", ["a"], *(("effect", ["a"]) if further else ("ambiguous", ["a", "b"]))).answer
            )
            if not further:
                answer["next_experiment"] = {"description": "as step_0p5, with its input times 0.5"}
            answers.mkdir(exist_ok=True)
            (answers / f"{case.parent.name}.json").write_text(json.dumps(answer))
        return True

    monkeypatch.setattr(Check, "_diagnose", diagnose)
    monkeypatch.setattr(Check, "_closures", lambda *_: {})
    only = next(i for i, c in enumerate(plan_cases(8, 1)) if c.kind == "none")
    check = Check(tmp_path / "out", tmp_path / "labels", ROOT / "campaigns" / "sealed", 8, (only,), 1, 1)
    (case,) = check.run().cases
    assert rounds == ["campaigns", "second_campaigns"]
    assert case.kind == "ambiguous"
    assert case.second is not None
    assert case.second["verdict"]["effects"] == ["a"]
    written = sorted(p for p in tmp_path.rglob("*.h5"))
    times = [p.stat().st_mtime_ns for p in written]
    check.run()
    assert [p.stat().st_mtime_ns for p in written] == times
    told = "".join(p.read_text() for p in (tmp_path / "out").rglob("*") if p.suffix in (".sha256", ".json"))
    assert "load_encoder" not in told


def blind(tmp_path: Path, *only: int) -> Outcome:
    """Make these cases of the grid of seed 5, diagnose them with their labels out of reach, and score them."""
    check = Check(
        tmp_path / "out", tmp_path / "labels", ROOT / "campaigns" / "sealed", seed=5, only=only, workers=2
    )
    outcome = check.run()
    assert outcome.closed
    assert outcome.digest == hashlib.sha256((tmp_path / "labels" / "labels.json").read_bytes()).hexdigest()
    return outcome


def verdicts(outcome: Outcome) -> dict[str, tuple[object, ...]]:
    return {str(c.label["case"]): (*c.label["effects"], "->", c.kind, *sorted(c.named)) for c in outcome.cases}


@pytest.mark.slow
def test_a_complete_actuator_one_effect_and_one_of_no_catalogue_are_told_apart_blind(tmp_path):
    """A complete actuator with little noise, mesh friction as large as the noise, friction at one spot of a turn."""
    outcome = blind(tmp_path, 40, 47, 190)
    assert verdicts(outcome) == {
        "c040": ("friction_patch", "->", "unknown"),
        "c047": ("->", "complete"),
        "c190": ("mesh_loss", "->", "effect", "mesh_loss"),
    }
    assert [c.answer["verdict"]["port"] for c in outcome.cases] == ["gear_friction", None, "gear_friction"]
    assert [c.closure is not None and c.closure > 0.6 for c in outcome.cases] == [False, False, True]
    assert "3 of 3 cases answered" in page(outcome, "make blind")


@pytest.mark.slow
def test_two_effects_a_faint_one_and_a_ripple_of_no_catalogue_are_found_blind(tmp_path):
    assert verdicts(blind(tmp_path, 4, 6, 59)) == {
        "c004": ("gear_ripple", "->", "unknown"),
        "c006": ("mesh_loss", "->", "effect", "mesh_loss"),
        "c059": ("sensor_lag", "sensor_gain", "->", "effect", "sensor_gain", "sensor_lag"),
    }
