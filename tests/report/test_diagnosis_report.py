import copy
import json

import pytest
import report_samples as samples
from printed_pages import filled
from report_page import Page

from fmuid.diagnosis.corrected import read_diagnosis
from fmuid.diagnosis.summary import facts, likeliest, sentences, summary, verdict_text
from fmuid.report import DiagnosisPictures, write_diagnosis_report
from fmuid.report.diagnosis_figures import (
    effects_figure,
    effects_table,
    gap_figure,
    range_text,
    seen_table,
    tables_figure,
)
from fmuid.report.interactive import specification


def test_a_reader_sees_where_what_and_how_much(tmp_path):
    path = write_diagnosis_report(
        samples.diagnosis(),
        tmp_path,
        campaign="Actuator",
        pictures=samples.pictures(),
        provenance={"seed": "7"},
    )
    page = Page(path.read_text())
    for words in (
        "Mesh loss is missing at gear_friction (94 %)",
        "friction grows with the load",
        "load_35p5, tau_sensor, load torque 20 … 35.5 N.m (41 %)",
        "9.4 → 6.1 refitted → 0.35 corrected",
        "0.93 (0.85 to 1.01)",
        "would separate mesh_loss from viscous by 7.2 standard deviations",
        "cannot tell apart: sensor_gain or saturation.",
        "No sensor would show: backlash. The fitted parameters would hide: sensor_offset.",
        "seed",
    ):
        assert words in " ".join(page.text.split()), words
    names = {p.stem for p in (tmp_path / "figures").iterdir()}
    assert names == {"excess-energy", "effects", "missing", "gap", "before-after"}


def test_no_page_on_paper_is_half_empty(tmp_path):
    arguments = {"campaign": "Actuator", "pictures": samples.pictures(), "provenance": {"seed": "7"}}
    *pages, _ = filled(write_diagnosis_report(samples.diagnosis(), tmp_path, **arguments))
    assert min(pages) > 0.55, pages


def test_what_is_not_known_is_left_out(tmp_path):
    diagnosis = samples.diagnosis()
    diagnosis["verdict"] = {"kind": "complete", "effects": [], "one_of": [], "port": None, "ports": []}
    diagnosis |= {"effects": [], "answers": [{"effects": ["none"], "probability": 1.0}]}
    diagnosis |= {"where": [], "alias_classes": []}
    del diagnosis["next_experiment"]
    path = write_diagnosis_report(diagnosis, tmp_path, campaign="Actuator", pictures=DiagnosisPictures())
    page = Page(path.read_text())
    assert "Complete (100 %): nothing is missing" in page.text
    assert "corrected" not in page.text.split("Provenance")[0].split("Parameters that changed")[0]
    assert {p.stem for p in (tmp_path / "figures").iterdir()} == {"gap"}
    assert "Next experiment" not in page.text


@pytest.mark.parametrize(
    ("kind", "effects", "one_of", "words"),
    [
        ("ambiguous", [], [["a"], ["b"]], "A or b is missing at gear_friction (94 %): these sensors"),
        (
            "ambiguous",
            ["load_friction@gear"],
            [["delay@speed"], ["lag@speed"]],
            "Load friction at gear is missing, and either delay at speed or lag at speed (94 %): these sensors",
        ),
        ("ambiguous", [], [["a"], ["b"], ["c"], ["d"]], "A or b or c or d is missing at"),
        ("ambiguous", [], [["a"], ["b"], ["c"], ["d"], ["e"]], "A or b or c or one of 2 others is missing at"),
        ("unknown", [], [], "Unknown effect at gear_friction (5 %): no effect"),
        ("insufficient", [], [], "Not enough data"),
        ("effect", ["mesh_loss", "viscous"], [], "Mesh loss and viscous are missing at gear_friction (94 %)"),
        ("partial", ["value@rotor.J"], [], "Another value of rotor.J is missing (94 %), and something else"),
    ],
)
def test_verdicts_in_words(kind, effects, one_of, words):
    diagnosis = copy.deepcopy(samples.diagnosis())
    diagnosis["verdict"] |= {"kind": kind, "effects": effects, "one_of": one_of}
    assert words in verdict_text(diagnosis)


def test_a_verdict_is_said_as_an_engineer_would():
    diagnosis = copy.deepcopy(samples.diagnosis())
    diagnosis["verdict"]["rest"] = {"gap": 1.3, "where": "tau_sensor in load_25, speed -1 … 1"}
    assert sentences(diagnosis) == [
        "Mesh loss is missing at gear_friction (94 %).",
        "With it, 0.93 of the gap is closed (0.85 to 1.01) on data that were not used.",
        "What is left: 1.3 times the noise, most of it tau_sensor in load_25, speed -1 … 1.",
    ]
    by_label = {
        fact.label: fact for fact in facts(diagnosis | {"verdict": diagnosis["verdict"] | {"stable": False}})
    }
    assert by_label["What is left"].value.startswith("1.3 times the noise")
    assert by_label["Stable"].tone == "warn"


@pytest.mark.parametrize(
    ("parameter", "has_threshold"), [("gear_friction.mesh_loss_threshold", True), ("lam", False)]
)
def test_only_a_law_with_a_threshold_is_said_to_act_beyond_it(parameter, has_threshold):
    """A description of the user's may have the word as well."""
    diagnosis = copy.deepcopy(samples.diagnosis())
    effect = next(e for e in diagnosis["effects"] if e["id"] == "mesh_loss")
    effect |= {"description": "loss beyond 3 rad/s", "parameters": {parameter: {}}}
    assert ("Mesh loss acts only beyond 3 rad/s." in sentences(diagnosis)) == has_threshold


@pytest.mark.parametrize(
    ("present", "bounded", "words"),
    [
        (True, False, "record a run with a different input; a single experiment"),
        (True, True, "repeat a run as it is"),
        (False, True, "larger inputs"),
    ],
)
def test_where_the_data_cannot_tell_it_is_said_what_to_record(present, bounded, words):
    diagnosis = copy.deepcopy(samples.diagnosis())
    diagnosis["verdict"] |= {"kind": "insufficient", "effects": []}
    diagnosis["gap"] |= {"present": present, "bounded": bounded}
    diagnosis["power"] = {}
    (advice,) = [fact.value for fact in facts(diagnosis) if fact.label == "What to do"]
    assert words in advice


@pytest.mark.parametrize(
    ("p_value", "words"),
    [(2e-5, "a gap beyond the noise, too small to matter (p < 0.001)"), (0.2, "no gap beyond")],
)
def test_a_gap_too_small_to_matter_is_not_called_none(p_value, words):
    diagnosis = copy.deepcopy(samples.diagnosis())
    diagnosis["verdict"] |= {"kind": "complete", "effects": [], "port": None, "ports": []}
    diagnosis["gap"] |= {"present": False, "p_value": p_value}
    assert {fact.label: fact.value for fact in facts(diagnosis)}["Is there a gap"].startswith(words)


def test_the_smallest_gain_that_would_have_been_seen_is_told_from_none():
    diagnosis = copy.deepcopy(samples.diagnosis())
    diagnosis["verdict"] |= {"kind": "complete", "effects": [], "port": None, "ports": []}
    diagnosis["power"] = {"sensor_gain": {"tau_sensor.gain": 1.0132}}
    assert "Smallest effects that would have been seen: sensor_gain (tau_sensor.gain = 1.013)" in summary(
        diagnosis
    )
    assert seen_table(diagnosis) is None
    diagnosis["gap"]["present"] = False
    assert seen_table(diagnosis).rows == (("sensor_gain", "tau_sensor.gain", 1.0132, ""),)


def test_of_many_names_the_first_ones_are_printed():
    diagnosis = copy.deepcopy(samples.diagnosis()) | {
        "hidden": {"unseen": list("abcdefghij"), "imitated": list("klmnopq")}
    }
    assert "No sensor would show: a, b, c, d, e, f, 4 more" in summary(diagnosis)
    assert "The fitted parameters would hide: k, l, m, n, o, p, q" in summary(diagnosis)


def test_a_verdict_that_is_not_likely_is_no_good_news():
    diagnosis = copy.deepcopy(samples.diagnosis())
    assert facts(diagnosis)[0].tone == "good"
    diagnosis["answers"][0]["probability"] = 0.15
    assert facts(diagnosis)[0].tone == "warn"


def test_of_an_unknown_effect_the_closest_is_named_and_nothing_is_called_corrected(tmp_path):
    diagnosis = copy.deepcopy(samples.diagnosis())
    diagnosis["verdict"] |= {"kind": "unknown", "effects": []}
    diagnosis["answers"][0]["closure"]["held_out"] = 0.3
    for effect, closes in zip(diagnosis["effects"], (0.4, 0.2, 0.1, 0.0), strict=False):
        if "closure" in effect:
            effect["closure"]["held_out"] = closes
    diagnosis["port_closures"] = {"gear_friction": 0.62, "torque_sensor": 0.1}
    diagnosis["best"] = {"effects": ["mesh_loss"], "closure": diagnosis["effects"][0]["closure"]}
    by_label = {fact.label: fact.value for fact in facts(diagnosis)}
    assert by_label["What comes closest"] == (
        "mesh_loss closes 0.40 (0.85 to 1.01) on held-out data, too little to be named (it takes 0.5); "
        "an arbitrary course over time at gear_friction 0.62"
    )
    assert by_label["Gap, in noise floors"] == "9.4 → 6.1 refitted"
    assert [b.label for b in gap_figure(diagnosis).bars] == [
        "nominal model",
        "nominal parameters refitted",
        "noise alone",
    ]


@pytest.mark.parametrize(
    ("description", "words"),
    [
        ("Friction grows with load", "friction grows with load"),
        ("T_hot.balance: loss of heat", "T_hot.balance: loss of heat"),
    ],
)
def test_a_description_goes_on_in_lower_case_but_for_names(description, words):
    diagnosis = copy.deepcopy(samples.diagnosis())
    next(e for e in diagnosis["effects"] if e["id"] == "mesh_loss")["description"] = description
    assert {fact.label: fact.value for fact in facts(diagnosis)}["In words"] == words


@pytest.mark.parametrize(("gap", "decades"), [(50.0, 1), (5e5, 2)])
def test_ticks_of_a_wide_gap_do_not_overlap(gap, decades):
    diagnosis = copy.deepcopy(samples.diagnosis())
    diagnosis["gap"]["nominal"] = gap
    layout = specification(gap_figure(diagnosis))["layout"]
    assert layout["xaxis"]["dtick"] == decades


def test_the_gap_is_drawn_effect_by_effect():
    bars = gap_figure(samples.diagnosis(), {"mesh_loss": 2.0}).bars
    assert [(b.label, b.note) for b in bars[2:]] == [
        ("with mesh_loss", "2.24"),
        ("corrected", "1.06"),
        ("noise alone", "1"),
    ]
    assert min(b.value for b in bars) == 1.0  # no error is below the noise


def test_answers_come_first_then_other_effects_that_were_judged():
    diagnosis = copy.deepcopy(samples.diagnosis())
    idle = [{"id": f"idle_{k}", "probability": 0.05} for k in range(20)]
    diagnosis["effects"] = idle + diagnosis["effects"]
    assert [b.label for b in effects_figure(diagnosis).bars] == ["mesh_loss", "viscous", "stribeck", "hysteresis"]
    assert [row[0] for row in likeliest(diagnosis)[1:]] == [
        "mesh_loss",
        "unknown",
        "none",
        "viscous",
        "stribeck",
        "hysteresis",
    ]
    assert [row[0] for row in effects_table(diagnosis, refitted=True).rows][:1] == ["mesh_loss"]


def test_parameters_of_effects_have_units():
    diagnosis = copy.deepcopy(samples.diagnosis())
    (effect,) = [e for e in diagnosis["effects"] if e["id"] == "mesh_loss"]
    name = next(iter(effect["parameters"]))
    table = effects_table(diagnosis, refitted=True, units={name: "N.m"})
    assert f"{name} = " in table.rows[0][-1]
    assert "N·m" in table.rows[0][-1]


def test_effects_that_only_together_are_an_answer_share_a_bar():
    diagnosis = copy.deepcopy(samples.diagnosis())
    diagnosis["verdict"]["effects"] = ["viscous", "mesh_loss"]
    diagnosis["answers"][0]["effects"] = ["viscous", "mesh_loss"]
    bars = effects_figure(diagnosis).bars
    assert [b.label for b in bars] == ["viscous + mesh_loss", "stribeck", "hysteresis"]
    assert bars[0].note == "probability 0.94"
    assert [b.role for b in bars] == ["final", "floor", "floor"]


@pytest.mark.parametrize(
    ("ends", "text"),
    [((-0.23673, -2.4e-6), "−0.237 … 0"), ((21.1526, 31.6057), "21.2 … 31.6"), ((0, 103.4), "0 … 103")],
)
def test_ranges_are_short_and_end_at_zero_where_they_mean_it(ends, text):
    assert range_text(*ends) == text


def test_a_diagnosis_of_version_1_is_read_as_one_of_version_2(tmp_path):
    old = {
        "format": "fmuid-diagnosis",
        "version": 1,
        "verdict": {"kind": "ambiguous", "effects": ["a", "b"], "port": None},
        "nominal": {"parameters": {"J": 1.0}},
        "model": {"parameters": {"J": 1.1}},
    }
    path = tmp_path / "diagnosis.json"
    path.write_text(json.dumps(old))
    assert read_diagnosis(path)["verdict"] == {
        "kind": "ambiguous",
        "effects": [],
        "one_of": [["a"], ["b"]],
        "port": None,
    }


def found_law():
    return {
        "id": "law_found@body",
        "port": "body",
        "formula": "3 W * tanh((p - 293.15)/15 K)",
        "modelica": "body.law_size*tanh((p - 293.15)/body.law_width)",
        "parameters": {
            "body.law_size": {"value": 3.0, "unit": "W", "standard_error": 0.1, "interval": [2.8, 3.2]},
            "body.law_width": {"value": 15.0, "unit": "K", "standard_error": None, "interval": None},
        },
        "effect": {},
        "model": {"parameters": {}},
        "closure": {"train": 0.97, "held_out": 0.96, "interval": [0.9, 1.0], "physical": {}},
        "gap": 0.1,
        "p_value": 0.4,
        "curve": {
            "variable": "p",
            "unit": "K",
            "flow_unit": "W",
            "x": [290.0, 300.0],
            "y": [0.0, 2.0],
            "held": "",
        },
        "reason": None,
    }


def unknown(law):
    kind = {"kind": "unknown", "effects": [], "one_of": [], "port": "body", "ports": ["body"], "stable": None}
    return samples.diagnosis() | {"verdict": kind, "law_found": law}


def test_a_law_found_is_said_with_its_formula_and_drawn(tmp_path):
    diagnosis = unknown(found_law())
    page = Page(write_diagnosis_report(diagnosis, tmp_path, campaign="Block").read_text())
    text = " ".join(page.text.split())
    assert "a flow of 3 W * tanh((p - 293.15)/15 K)" in text
    assert "body.law_size*tanh((p - 293.15)/body.law_width)" in text
    assert (tmp_path / "figures" / "law-found.png").is_file()
    assert "Closed on held-out data by the law found: 0.96 (0.90 to 1.00); no more than noise is left" in summary(
        diagnosis
    )
    assert sentences(diagnosis)[-1] == (
        "A law found at body explains it: a flow of 3 W * tanh((p - 293.15)/15 K). With it, 0.96 of the gap is closed"
        " on held-out runs (0.90 to 1.00)."
    )


def with_table(**changes):
    axis = {"variable": "temperature", "unit": "K", "knots": [290.0, 300.0, 310.0]}
    table = {
        "id": "learned_table@body(temperature)",
        "law": "learned_table@body(temperature)",
        "learned": True,
        "port": "body",
        "variable": "temperature",
        "table": {"axes": [axis], "values": [0.0, 2.0, -3.0], "unit": "W"},
        "effect": {"acts": "flow"},
    } | changes
    best = {
        "effects": [table["law"]],
        "refinements": [table],
        "closure": {"train": 0.9, "held_out": 0.8, "interval": [0.7, 0.9], "physical": {}},
        "gap": 0.4,
    }
    return unknown(None) | {"best": best, "refinements": [table]}


def test_a_learned_table_is_said_and_drawn(tmp_path):
    diagnosis = with_table()
    assert "Learned table: 3 values up to 3 W at body, for temperature from 290 to 310 K" in summary(diagnosis)
    assert "Closed on held-out data with the table: 0.80 (0.70 to 0.90)" in summary(diagnosis)
    assert sentences(diagnosis)[-1] == (
        "A table learned at body over temperature predicts it, which is no law: with it, 0.80 of the gap is closed"
        " (0.70 to 0.90) on data that were not used."
    )
    write_diagnosis_report(diagnosis, tmp_path, campaign="Block")
    assert (tmp_path / "figures" / "tables.png").is_file()


def test_a_monotone_table_is_called_so_and_drawn_so():
    axis = {"variable": "temperature", "unit": "K", "knots": [290.0, 300.0, 310.0]}
    diagnosis = with_table(table={"axes": [axis], "values": [0.0, 2.0, 3.0], "unit": "W", "monotone": "rising"})
    assert "Learned table: 3 rising values up to 3 W at body, for temperature from 290 to 310 K" in summary(
        diagnosis
    )
    assert sentences(diagnosis)[-1].startswith("A rising table learned at body over temperature predicts it")
    figure = tables_figure(diagnosis)
    assert figure is not None
    assert figure.panels[0].y.name == "learned at body, only rising"


def test_a_refinement_is_said_under_the_name_of_its_law():
    diagnosis = with_table(id="refinement@body(temperature)", law="loss@body", learned=False)
    assert sentences(diagnosis)[-1].startswith(
        "The plant's law has another shape than loss at body: with a table over temperature that refines it, 0.80"
    )


def test_a_refined_coefficient_that_is_all_that_is_missing_is_told_once():
    id, law = "refinement@UA(wind)", "varies@UA(wind)"
    axis = {"variable": "wind", "unit": "m/s", "knots": [0.0, 4.0, 8.0]}
    values = {"axes": [axis], "values": [-0.1, 0.0, 0.25], "unit": "1", "monotone": "rising"}
    refined = with_table(id=id, law=law, learned=False, port="UA", variable="wind", table=values)
    refined["refinements"][0]["effect"] = {"acts": "parameter"}
    answer = {"effects": [law], "probability": 0.95, "closure": refined["best"]["closure"]}
    verdict = refined["verdict"] | {"kind": "effect", "effects": [law]}
    told = refined | {"answers": [answer], "verdict": verdict}
    text = " ".join(sentences(told))
    assert text.count("of the gap is closed") == 1
    assert "has another shape than varies at UA(wind), so a rising table over wind refines it." in text
    assert any(f.value == "3 rising values up to 25 % of UA, for wind from 0 to 8 m/s" for f in facts(told))
    figure = tables_figure(told)
    assert figure is not None
    assert figure.panels[0].y.name == "relative change of UA, only rising"


def test_a_table_over_two_variables_has_a_line_for_each_value_of_the_second(tmp_path):
    axes = [{"variable": n, "unit": "1", "knots": [0.0, 1.0, 2.0][:k]} for n, k in (("a", 3), ("b", 2))]
    values = [[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]]
    diagnosis = with_table(variable="a and b", table={"axes": axes, "values": values, "unit": "W"})
    figure = tables_figure(diagnosis)
    assert figure is not None
    (panel,) = figure.panels
    assert [line.label for line in panel.series] == ["b = 0", "b = 1"]
    assert [list(line.y) for line in panel.series] == [[0.0, 2.0, 4.0], [1.0, 3.0, 5.0]]


def test_without_a_law_the_reason_is_said(tmp_path):
    diagnosis = unknown({"formula": None, "reason": "no term of the library explains more than noise would"})
    page = Page(write_diagnosis_report(diagnosis, tmp_path, campaign="Block").read_text())
    assert "no term of the library explains more than noise would" in " ".join(page.text.split())
    assert "Law found: none: no term of the library explains more than noise would" in summary(diagnosis)
    assert not (tmp_path / "figures" / "law-found.png").exists()
