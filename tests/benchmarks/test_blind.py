"""The blind check on random rigs: its plants, its cases, and what it makes of answers."""

from __future__ import annotations

import ast
import json
import subprocess
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from benchmarks.blind import plants
from benchmarks.blind.__main__ import answered, pages, publish, verify, write_pages
from benchmarks.blind.agreement import TOLERANCE, disagreement
from benchmarks.blind.plants.cases import draw_case, numbers, stratum_of, write_case
from benchmarks.blind.plants.effects import SHAPES, Effect, candidates, other_names, usual, varying
from benchmarks.blind.plants.grammar import draw_rig, wave
from benchmarks.blind.plants.readings import Gaps, Run, Way, simulate
from benchmarks.blind.score import Scored, as_measured, bias, figures, localisation, share

LABEL = {
    "seed": 1, "rig": 0, "case": "c0000", "number": 0, "stratum": "one", "effects": ["lag@y"], "same": {"lag@y": ["delay@y"]},
    "background_effects": ["offset@u"], "background_same": ["gain@u"], "repeats": 1, "loud": False, "own_shape": False, "twin_of": None, "damaged": [], "units": False, "as_well": {"lag@y": ["drift@y"]},
    "places": ["y"], "sizes": {}, "gap": 2.0, "background": 0.2, "noise": "white", "timing": "held", "moving": False,
    "closed": 0, "style": "components", "kind": "thermal", "determined": ["a"], "values": {"a": 2.0},
}  # fmt: skip

VARYING = ["varies@wire.R(core.T)", "varies@wire.R(time)", "varies@lead.R(core.T)", "value@wire.R"]


def scored(kind="effect", effects=(), one_of=(), ports=(), **label):
    verdict = {"kind": kind, "effects": list(effects), "one_of": [list(s) for s in one_of], "ports": list(ports)}
    answer = {"verdict": verdict, "answers": [], "effects": [], "where": [], "model": {"parameters": {"a": 2.2}}}
    return Scored(LABEL | label, {"answer": answer, "seconds": 3.0, "free": ["a"], "refused": []})


def test_plants_share_nothing_with_the_program():
    folder = Path(plants.__path__[0])
    for file in folder.glob("*.py"):
        tree = ast.walk(ast.parse(file.read_text()))
        names = [
            n.module if isinstance(n, ast.ImportFrom) else a.name
            for n in tree
            if isinstance(n, ast.Import | ast.ImportFrom)
            for a in n.names
        ]
        assert not [n for n in names if n.startswith(("fmuid", "fmu_build"))]


def driven(number, seed=3):
    rig, rng = draw_rig(seed, number), np.random.default_rng(1)
    u = np.stack([wave(rng, s, rig.samples, "steps") for s in rig.inputs])
    return rig, Run(u, rig.network.start(), np.linspace(0.0, 1.0, rig.samples)[None, :]), usual(rig, u)


def test_every_law_has_two_to_four_shapes_of_which_none_is_the_catalogues():
    assert set(SHAPES.values()) <= {2, 3, 4}
    seen = set()
    for number in range(60):
        rig, run, typical = driven(number)
        rng = np.random.default_rng(1)
        acting = [*candidates(rig, typical, rng), *(v.candidate for v in varying(rig, typical, rng))]
        for one in acting:
            if one.law in seen:
                continue
            size = 3.0 if isinstance(one.effect, Effect) else 2.0
            shaped = [replace(one.sized(size), shape=k) for k in range(SHAPES[one.law] + 1)]
            read = [simulate(rig, rig.network, [e], run, Way(), typical)[0] for e in shaped]
            if np.ptp(read[0] - simulate(rig, rig.network, [], run, Way(), typical)[0]) == 0.0:
                continue  # a rim that is not reached
            seen.add(one.law)
            apart = [np.abs(a - b).max() / np.ptp(a) for a, b in combinations(read, 2)]
            assert min(apart) > 1e-6, one.law
    assert seen == set(SHAPES)


def test_an_effect_that_cannot_be_seen_excuses_no_other_name():
    rig, run, typical = driven(16)
    known = candidates(rig, typical, np.random.default_rng(1))
    gaps = Gaps(rig, rig.nominal, [run], Way(), typical, "white")
    one = next(c for c in known if c.law == "capacity")
    small, _ = gaps.sized(one, 0.002)
    large, _ = gaps.sized(one, 1.0)
    assert gaps.twins_of(small, known, 1, one.id)[0] == []
    twin = replace(one, law="twin")  # another name for it
    assert gaps.twins_of(large, [*known, twin], 1, one.id)[0] == [twin.id]
    against = replace(one, law="against", effect=replace(one.effect, size=-one.effect.size))
    assert gaps.twins_of(large, [against], 1)[0] == []


@pytest.mark.parametrize("number", [0, 5, 16])
def test_a_complete_plant_and_its_model_agree(number, tmp_path):
    assert disagreement(draw_rig(3, number), 3, tmp_path) < TOLERANCE


@pytest.mark.slow
@pytest.mark.parametrize("number", range(50))
def test_fifty_random_rigs_agree_with_their_models(number, tmp_path):
    assert disagreement(draw_rig(4, number), 4, tmp_path) < TOLERANCE


def test_a_seed_gives_the_same_rigs_and_logs_and_another_one_others(tmp_path):
    one, again, other = draw_case(5, 16), draw_case(5, 16), draw_case(6, 16)
    assert write_case(one, tmp_path / "one") == write_case(again, tmp_path / "again")
    assert one.label == again.label
    assert one.rig.nominal != other.rig.nominal


def test_strata_come_in_their_shares_and_the_background_is_as_large_as_asked_for():
    strata = [stratum_of(1, k) for k in range(100)]
    assert {s: strata.count(s) for s in set(strata)} == {
        "none": 25, "one": 30, "two": 10, "varies": 10, "unknown": 15, "regime": 10,
    }  # fmt: skip
    label = draw_case(5, 16).label
    low, high = (0.7, 1.3) if label["loud"] else (0.07, 0.65)
    assert low < label["background"] < high


def test_cases_of_one_stratum_are_counted_alone_and_without_twins():
    assert numbers(1, 2, 3) == [2, 3, 4]
    chosen = numbers(1, 5, 20, "varies")
    assert {stratum_of(1, k) for k in chosen} == {"varies"}
    assert min(chosen) >= 5
    assert len(chosen) == 20
    assert not [k for k in chosen if k % 8 == 7]


def test_a_twin_has_the_same_noise_in_other_units(tmp_path):
    case, twin = draw_case(5, 14), draw_case(5, 15)
    assert twin.label["twin_of"] == "c0014"
    logs = []
    for one, name in ((case, "case"), (twin, "twin")):
        write_case(one, tmp_path / name)
        file = next((tmp_path / name).glob("*_1.csv"))
        header, *rows = file.read_text().splitlines()
        logs.append((header.split(","), np.array([row.split(",") for row in rows], dtype=float)))
    count = 1 + len(case.rig.inputs) + len(case.rig.outputs)
    (head, a), (other, b) = logs
    assert head[:count] != other[:count]
    factors = a[:, 1:count].std(axis=0) / b[:, 1:count].std(axis=0)
    assert np.allclose(a[:, 1:count], b[:, 1:count] * factors, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize(
    ("verdict", "right", "wrong"),
    [
        ({"effects": ["lag@y"]}, True, False),
        ({"effects": ["delay@y"]}, True, False),  # the runs cannot tell it from the lag
        ({"effects": ["lag@y", "offset@u"]}, True, False),  # of the background
        ({"effects": ["lag@y", "gain@u"]}, True, False),  # the runs cannot tell it from one of the background
        ({"effects": ["gain@y"]}, False, True),
        ({"effects": ["lag@y", "gain@y"]}, False, True),
        ({"kind": "ambiguous", "one_of": [["lag@y"], ["delay@y"]]}, True, False),
        ({"kind": "ambiguous", "one_of": [["lag@y"], ["gain@y"]]}, False, False),
        ({"kind": "unknown"}, False, False),
        ({"kind": "complete"}, False, False),
    ],
)
def test_what_is_right_and_what_is_a_wrong_name(verdict, right, wrong):
    case = scored(**verdict)
    assert (case.right, case.wrong) == (right, wrong)


@pytest.mark.parametrize(
    ("equal", "right", "wrong"),
    [
        ([], False, True),
        ([[["gain@u"], ["coulomb@joint"]]], True, False),
        ([[["gain@v"], ["lag@u"]]], False, True),
    ],
    ids=["one name", "another name is the truth", "names of another answer"],
)
def test_an_answer_that_is_one_model_under_several_names_counts_by_any_of_them(equal, right, wrong):
    record = scored(effects=["gain@u"]).record
    label = LABEL | {"effects": ["coulomb@joint"], "same": {}, "background_effects": [], "background_same": []}
    case = Scored(label, record | {"answer": record["answer"] | {"equal": equal}})
    assert (case.right, case.wrong) == (right, wrong)


def test_a_model_is_complete_to_its_tolerance():
    assert scored(kind="complete", gap=0.97).right
    assert not scored(kind="complete", gap=1.1).right


@pytest.mark.parametrize(
    ("alone", "gap", "stratum", "complete", "named", "loud"),
    [
        ([3.0], 3.0, "one", False, True, False),
        ([0.4], 0.5, "none", True, False, False),  # the parameters take up the effect
        ([0.4], 1.6, "none", False, False, True),
    ],
)
def test_a_label_says_what_refits_to_the_end_leave(alone, gap, stratum, complete, named, loud):
    label = as_measured(LABEL, {"alone": alone, "gap": gap, "background": 0.3, "determined": []})
    assert (label["stratum"], label["loud"], label["gap"], label["determined"]) == (stratum, loud, gap, [])
    verdicts = [scored(kind="complete"), scored(effects=["lag@y"]), scored(effects=["drift@y"])]
    cases = [Scored(label, one.record) for one in verdicts]
    assert [case.right for case in cases] == [complete, named, False]
    assert [case.wrong for case in cases] == [False, False, True]


@pytest.mark.parametrize(
    ("truth", "parameter", "units", "value"),
    [
        ("quadratic@cart", "cart.quadratic", False, 1.0),
        ("capacity@core", "core.capacity", True, 1.0),
        ("delay@y", "y.delay", True, 1.0),
        ("lag@y", "y.lag", False, None),  # depends on how it is split
        ("offset@u", "u.offset", True, None),  # in the unit of the log
        ("quadratic@cart", "cart.quadratic_width", False, None),
    ],
)
def test_a_size_is_that_of_the_law(truth, parameter, units, value):
    label = LABEL | {"effects": [truth], "sizes": {truth: 2.0}, "units": units, "same": {}}
    shares = []
    for size in (2.1, 2.4):
        case = Scored(label, scored(effects=[truth]).record)
        parameters = {parameter: {"value": size, "standard_error": 0.1}}
        case.answer["effects"].append({"id": truth, "parameters": parameters})
        shares.append(next(f for f in figures([case]) if f.name.startswith("size inside")).value)
    assert shares == ([value, 0.0] if value else [None, None])


def test_a_coefficient_has_to_be_named_with_what_it_varies_with():
    label = {"stratum": "varies", "effects": ["varies@wire.R"], "variable": ["core"], "same": {}}
    named = {n: Scored(LABEL | label, scored(effects=[n]).record) for n in VARYING}
    assert [n for n, case in named.items() if case.right] == [VARYING[0]]
    assert named["value@wire.R"].wrong
    warm = Scored(
        LABEL | label | {"variable": ["memory", "warming"]}, scored(effects=["varies@wire.R(warmth)"]).record
    )
    assert warm.right


def test_an_unknown_effect_may_be_named_as_a_law_that_the_runs_cannot_tell_from_it():
    label = {"stratum": "unknown", "effects": ["resonator@core"], "same": {"resonator@core": ["capacity@core"]}}
    for verdict, right, wrong in (
        ({"kind": "unknown"}, True, False),
        ({"effects": ["capacity@core"]}, True, False),
        ({"effects": ["loss@core"]}, False, True),
    ):
        case = Scored(LABEL | label, scored(**verdict).record)
        assert (case.right, case.wrong) == (right, wrong)


def test_a_miss_that_fits_as_well_as_the_law_of_the_truth_is_told_so():
    assert "no worse" in scored(effects=["drift@y"]).reason
    assert "no worse" in scored(effects=["varies@a.d(wheel.w)"], as_well={"lag@y": ["varies@a.d(wheel)"]}).reason
    assert "no worse" not in scored(effects=["gain@y"]).reason


def test_only_the_damaged_logs_may_be_refused():
    figure = {}
    for refused in ([], ["aborted_1.csv"], ["steps_1_1.csv"], ["aborted_1.csv", "steps_1_1.csv"]):
        case = scored(damaged=["text"])
        case.record["refused"].extend([n, "said"] for n in refused)
        figure[tuple(refused)] = next(f for f in figures([case]) if f.name.startswith("damaged")).value
    assert [n for n, value in figure.items() if value == 1.0] == [("aborted_1.csv",)]


def test_what_corrects_an_unknown_effect_counts_also_where_nothing_does():
    cases = [scored(kind="unknown", stratum="unknown", case=f"c{k}") for k in range(3)]
    cases[0].answer["best"] = {"closure": {"held_out": 0.8}}
    cases[0].answer["law_found"] = {"formula": "1 N*p"}
    cases[1].answer["corrected_differs"] = 0.2
    shares = {f.name.partition(",")[0]: f.value for f in figures(cases)}
    assert shares["unknown: corrected/ closes on left-out runs"] == 0.0
    assert shares["unknown: an equation is found"] == pytest.approx(1 / 3)
    assert shares["corrected/ is the fitted model"] == 0.0


def test_a_law_may_be_named_as_a_coefficient_that_varies_where_that_is_the_same():
    rig, run, typical = driven(0)
    damper = next(e for e in rig.network.elements if e.kind == "cond")
    assert rig.network.nodes[damper.a].mechanical
    node = rig.network.nodes[damper.a]
    known = candidates(rig, typical, np.random.default_rng(1))
    one = next(c for c in known if c.law == "quadratic" and c.effect.where == damper.a)
    gaps = Gaps(rig, rig.nominal, [run], Way(), typical, "white")
    effect, _ = gaps.sized(one, 1.0)
    same = gaps.twins_of(effect, other_names(rig, typical), 1, one.id)[0]
    parameter = next(
        p.name for p in rig.parameters if p.slot == ("element", rig.network.elements.index(damper), 0)
    )
    assert f"varies@{parameter}({node.name})" in same
    case = scored(effects=[f"varies@{parameter}({node.name}.w)"])
    assert Scored(LABEL | {"effects": [one.id], "same": {one.id: same}}, case.record).right
    assert not Scored(LABEL | {"effects": [one.id], "same": {}}, case.record).right


def test_the_ends_of_a_branch_may_come_in_either_order():
    label = {"effects": ["backlash@v_a.v_b"], "same": {}}
    assert Scored(LABEL | label, scored(effects=["backlash@v_b.v_a"]).record).right


def test_an_interval_is_wider_where_cases_of_a_rig_go_together():
    rigs = [[True] * 4] * 15 + [[False] * 4] * 5
    mixed = [[True, True, True, False]] * 20

    def figure(groups):
        cases = [(scored(rig=k), hit) for k, hits in enumerate(groups) for hit in hits]
        return share("", [c for c, _ in cases], lambda case: next(h for c, h in cases if c is case))

    together, apart = figure(rigs), figure(mixed)
    assert together.value == apart.value == 0.75
    width = [f.interval[1] - f.interval[0] for f in (together, apart)]
    assert width[0] > 1.5 * width[1]
    assert together.new_rig[0] < together.interval[0]


def test_the_regime_that_is_named_is_compared_sample_by_sample():
    regime = {"what": "rate", "over": 1.0, "trace": [-2.0, -0.5, 0.5, 1.5, 2.5, 0.0]}
    case = scored(stratum="regime", regime=regime, places=["rotor"], kind="unknown")
    assert localisation(case) == 0.0
    # Neither a position nor time is what decides.
    case.answer["where"].append({"regime": {"variable": "phi_rotor", "unit": "rad", "from": 1.2, "to": 3.0}})
    case.answer["where"].append({"regime": {"variable": "time", "unit": "s", "from": 1.2, "to": 3.0}})
    assert localisation(case) == 0.0
    case.answer["where"].append({"regime": {"variable": "rotor.w", "unit": "rad/s", "from": 1.2, "to": 3.0}})
    assert localisation(case) == pytest.approx(2 * 2 / (3 + 2))
    assert bias(case) == pytest.approx(0.1)


def test_the_page_is_what_is_published_and_a_changed_answer_is_noticed(tmp_path, monkeypatch):
    labels, work = tmp_path / "labels", tmp_path / "work"
    case = draw_case(5, 16)
    hashes = write_case(case, work / "cases" / "c0016")
    (work / "answers" / "c0016").mkdir(parents=True)
    labels.mkdir()
    (labels / "c0016.json").write_text(json.dumps({**case.label, "sha256": hashes}))
    (work / "answers" / "c0016" / "record.json").write_text(json.dumps(scored(kind="complete").record))
    monkeypatch.setattr("benchmarks.blind.__main__.PUBLISHED", tmp_path / "published")
    monkeypatch.setattr("benchmarks.blind.__main__.PAGE", tmp_path / "blind.md")
    folder = publish(5, work, labels)
    write_pages()
    assert verify(1) == []
    answers = folder / "answers.jsonl"
    answers.write_text(answers.read_text().replace('"complete"', '"unknown"'))
    (folder / "logs.sha256").write_text((folder / "logs.sha256").read_text().replace("  c", "0  c", 1))
    assert len(verify(1)) == 3  # both pages and the logs
    measured = folder / "measured.jsonl"
    measured.write_text(measured.read_text().replace('"gap":', '"gap":9'))
    assert any("the gap of c0016" in line for line in verify(1))
    labels = folder / "labels.jsonl"
    labels.write_text(labels.read_text().replace('"stratum":"', '"stratum":"x'))
    assert any("the label of c0016" in line for line in verify(1))


def test_a_diagnosis_may_take_so_much_processor_time(tmp_path, monkeypatch):
    spinning = "import resource; resource.setrlimit(resource.RLIMIT_CPU, (1, 1))\nwhile True: pass"
    real = subprocess.run
    monkeypatch.setattr(subprocess, "run", lambda command, **how: real([command[0], "-c", spinning], **how))
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "c0000.json").write_text("{}")
    assert "no answer in 1 s of processor time" in answered(1, 0, tmp_path, tmp_path / "labels", 1.0)


def test_the_committed_pages_are_what_the_published_seeds_give():
    assert all(file.read_text(encoding="utf-8") == text for file, text in pages().items())


def test_without_cases_no_figure_is_made_up():
    assert all(f.value is None for f in figures([]))
