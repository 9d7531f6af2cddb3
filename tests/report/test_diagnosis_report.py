import copy

import pytest
import report_samples as samples
from report_page import Page

from fmuid.report import DiagnosisPictures, write_diagnosis_report
from fmuid.report.diagnosis import verdict_text


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
        "mesh_loss (94 %) at gear_friction",
        "load_35p5, tau_sensor, load torque 20 … 35.5 (41 %)",
        "9.4 → 6.1 refitted → 0.35 corrected",
        "0.93 (0.85 to 1.01)",
        "would separate mesh_loss from viscous by 7.2 standard deviations",
        "sensor_gain = saturation",
        "seed",
    ):
        assert words in " ".join(page.text.split()), words
    names = {p.stem for p in (tmp_path / "figures").iterdir()}
    assert names == {"excess-energy", "effects", "missing", "gap", "residuals"}


def test_what_is_not_known_is_left_out(tmp_path):
    diagnosis = samples.diagnosis()
    diagnosis["verdict"] = {"kind": "complete", "effects": [], "port": None}
    diagnosis |= {"effects": [{"id": "none", "probability": 1.0}], "where": [], "alias_classes": []}
    del diagnosis["next_experiment"]
    path = write_diagnosis_report(diagnosis, tmp_path, campaign="Actuator", pictures=DiagnosisPictures())
    page = Page(path.read_text())
    assert "Complete: nothing is missing" in page.text
    assert {p.stem for p in (tmp_path / "figures").iterdir()} == {"gap"}
    assert "Next experiment" not in page.text


@pytest.mark.parametrize(
    ("kind", "effects", "words"),
    [
        ("ambiguous", ["a", "b"], "a or b at gear_friction: these sensors"),
        ("unknown", [], "Unknown effect at gear_friction"),
        ("insufficient", [], "Not enough data"),
        ("effect", ["mesh_loss", "viscous"], "mesh_loss (94 %) and viscous (2 %) at gear_friction"),
    ],
)
def test_verdicts_in_words(kind, effects, words):
    diagnosis = copy.deepcopy(samples.diagnosis())
    diagnosis["verdict"] |= {"kind": kind, "effects": effects}
    assert words in verdict_text(diagnosis)
