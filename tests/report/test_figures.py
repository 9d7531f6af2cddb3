import base64
import csv
import io
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import report_samples as samples

from fmuid.core.errors import FmuidError
from fmuid.report.figures import StageHistory, milestones, parallel_criteria_figure, parallel_figure
from fmuid.report.interactive import packed, specification
from fmuid.report.plots import render, save_data, save_figure, save_figures
from fmuid.report.plots.draw import canvas_of
from fmuid.report.plots.figure_data import (
    Axis,
    Bar,
    BarFigure,
    LineFigure,
    Panel,
    Series,
    Table,
    pretty_unit,
    tables,
)
from fmuid.report.thinning import kept_samples

figures = pytest.mark.parametrize("make", samples.ALL, ids=lambda make: make.__name__)


@figures
def test_every_kind_is_drawn_in_every_format(make, tmp_path):
    paths = save_figure(make(), tmp_path, ("png", "svg", "pdf"))
    beginnings = [path.read_bytes()[:4] for path in paths]
    assert beginnings == [b"\x89PNG", b"<?xm", b"%PDF"]


def test_equal_values_give_equal_bytes():
    for format in ("png", "svg", "pdf"):
        assert render(samples.friction(), format) == render(samples.friction(), format)


def test_axes_are_labelled_with_units():
    text = render(samples.friction(), "svg").decode()
    assert "speed / (rad/s)" in text
    assert "friction torque / (N·m)" in text
    assert "law, truth" in text


def test_numbers_at_axes_are_text():
    x = np.linspace(0.0, 1.0, 50)
    panels = [
        Panel("", Axis("t", "s"), axis, (Series("y", x, y, "final"),))
        for axis, y in (
            (Axis("y", "N", log=True), 10.0 ** (6.0 * x - 4.0)),
            (Axis("y", "N"), 3e-6 * x),
            (Axis("y", "N"), 1234.5 + 1e-3 * x),
        )
    ]
    text = render(LineFigure("numbers", "", tuple(panels), "", 2), "svg").decode()
    for number in ("10⁻⁴", "10²", "×10⁻⁶", "+1.2345×10³"):
        assert f">{number}<" in text


@pytest.mark.parametrize("name", ["output_angle / rad", "temperature_of_winding / (N·m)"])
def test_headings_of_a_map_do_not_touch(name):
    groups, columns = ((name, 6),) * 5, tuple(str(k) for k in range(30))
    canvas = canvas_of(replace(samples.energy_map(), columns=columns, values=np.ones((8, 30)), groups=groups))
    canvas.draw_without_rendering()
    headings = canvas.axes[0].texts
    assert len(headings) == 5
    assert {text.get_fontsize() for text in headings} == {7.0}
    places = [text.get_window_extent() for text in headings]
    if slope := np.sin(np.radians(headings[0].get_rotation())):  # then lines are parallel
        assert all((b.x0 - a.x0) * slope > 1.2 * 7.0 * canvas.dpi / 72 for a, b in pairwise(places))
    else:
        assert all(a.x1 + 5 < b.x0 for a, b in pairwise(places))


def test_an_unknown_format_is_refused():
    with pytest.raises(FmuidError, match="png, svg or pdf"):
        render(samples.friction(), "jpg")


def test_drawing_leaves_the_callers_matplotlib_alone():
    import matplotlib

    before = dict(matplotlib.rcParams)
    render(samples.history())
    assert dict(matplotlib.rcParams) == before


def test_importing_the_report_does_not_import_what_takes_a_second():
    code = "import sys, fmuid.report; sys.exit(bool({'matplotlib', 'plotly', 'scipy.stats'} & {*sys.modules}))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@figures
def test_plotly_accepts_every_kind(make):
    import plotly.graph_objects as go

    spec = specification(make())
    for trace in spec["data"]:  # as the page does
        if isinstance(trace.get("x"), int):
            trace["x"] = spec["shared"][trace["x"]]
    go.Figure(data=spec["data"], layout=spec["layout"])  # refuses what plotly.js does not know


def test_every_line_finds_its_own_abscissa():
    spec = specification(samples.friction())
    for series, trace in zip(
        samples.friction().panels[0].series,
        [t for t in spec["data"] if not t.get("showlegend", True)],
        strict=True,
    ):
        x = spec["shared"][trace["x"]]
        np.testing.assert_allclose(np.frombuffer(base64.b64decode(x["bdata"]), x["dtype"]), series.x, rtol=1e-6)


def test_a_shared_abscissa_travels_once():
    spec = specification(samples.overlays(5))
    assert len(spec["shared"]) == 1
    assert len(specification(samples.friction())["shared"]) == 2


def test_a_long_quantity_on_the_last_axis_of_a_row_stays_inside_the_figure():
    line = Series("law", np.arange(3.0), np.arange(3.0), "final")
    panels = tuple(Panel("", Axis("w_impeller.balance angle", "rad"), Axis("y"), (line,)) for _ in range(3))
    canvas = canvas_of(LineFigure("missing", "", panels, "", 3))
    canvas.draw_without_rendering()
    for axes in canvas.axes:
        assert axes.get_xlabel() == "w_impeller.balance angle / rad"
        assert axes.xaxis.label.get_window_extent().x1 <= canvas.bbox.x1


def test_lines_are_the_same_on_screen_as_in_the_data():
    figure = samples.history()
    drawn = {t["name"]: t for t in specification(figure)["data"] if not t.get("showlegend", True)}
    raw = np.frombuffer(base64.b64decode(drawn["final"]["y"]["bdata"]), drawn["final"]["y"]["dtype"])
    np.testing.assert_allclose(raw, samples.step_response(40), rtol=1e-6, atol=1e-6)
    assert {"evaluation 4", "evaluation 9", "evaluation 20"} <= drawn.keys()


def test_iterates_share_one_entry_in_the_legend():
    shown = [t["name"] for t in specification(samples.history())["data"] if t.get("showlegend", True)]
    assert shown == ["measurement", "start", "intermediate iterates", "final"]


def test_times_far_from_zero_keep_their_resolution():
    time = 1e6 + np.arange(1000) * 1e-3
    assert packed(time)["dtype"] == "f8"
    assert packed(time - 1e6)["dtype"] == "f4"


def test_names_cannot_become_markup():
    panel = Panel("<b>x", Axis("<i>t", "s"), Axis("y"), (Series("<script>", np.arange(3), np.arange(3), "final"),))
    text = str(specification(LineFigure("f", "f", (panel, panel))))
    assert "<script>" not in text
    assert "<b>x" not in text


def test_data_behind_a_figure_reads_back(tmp_path):
    (path,) = save_data(samples.history(), tmp_path)
    header, *rows = csv.reader(io.StringIO(path.read_text()))
    assert header[:3] == ["time [s]", "measurement: tau_sensor [N.m]", "start: tau_sensor [N.m]"]
    values = np.array(rows, dtype=float)
    np.testing.assert_allclose(values[:, -1], samples.step_response(40), rtol=1e-8)


def test_series_over_different_abscissae_are_written_one_below_the_other():
    ((_, table),) = tables(samples.friction())
    assert table.header == ("series", "speed [rad/s]", "friction torque [N.m]", "error")
    assert {row[0] for row in table.rows} == {"K_m mean(i_motor)", "law, identified", "law, truth"}
    assert len(table.rows) == 8 + 2 * 201


def test_one_table_for_each_panel():
    names = [name for name, _ in tables(samples.overlays(3))]
    steps = [f"validation-0{k + 1}-step-{k}" for k in range(3)]
    assert names == [name for step in steps for name in (step, f"{step}-residual")]


def test_a_good_fits_residual_lies_beneath_it_between_two_standard_deviations_of_the_noise():
    (panel, *_) = samples.overlays(2).panels
    residual, *band = panel.beneath.series
    np.testing.assert_allclose(residual.y, samples.step_response(4) - samples.step_response(5))
    assert sorted({float(y) for s in band for y in s.y}) == [-0.4, 0.4]


def test_panels_of_a_run_zoom_together_and_lie_below_each_other_on_a_phone():
    spec = specification(samples.overlays(3))
    assert sorted(spec["links"].values()) == sorted([f"step {k}" for k in range(3)] * 2)
    assert spec["layout"]["xaxis2"]["matches"] == "x"
    assert spec["layout"]["xaxis6"]["matches"] == "x5"
    assert spec["layout"]["xaxis3"]["domain"][0] > 0.5  # the second run, to the right of the first
    assert spec["narrow"]["xaxis3"]["domain"][0] == 0.0
    ends = [spec["narrow"][f"yaxis{k}"]["domain"] for k in ("", 2, 3, 4, 5, 6)]
    assert all(upper[0] > lower[1] for upper, lower in pairwise(ends))
    assert spec["narrow"]["height"] > 1.3 * spec["layout"]["height"]


def test_a_maps_blocks_share_the_width_that_there_is():
    spec = specification(samples.energy_map())
    assert [len(trace["z"][0]) for trace in spec["data"]] == [4, 4, 4]
    assert spec["layout"]["yaxis3"]["domain"] == spec["layout"]["yaxis"]["domain"]
    assert spec["narrow"]["yaxis3"]["domain"][1] < spec["narrow"]["yaxis"]["domain"][0]


def test_long_names_of_a_maps_rows_and_blocks_are_folded_and_not_cut():
    name, block = (
        "run_of_the_third_of_november_2 · temperature of the housing",
        "temperature of the housing / degC",
    )
    map_ = samples.energy_map()
    count = len(map_.columns) // 2
    map_ = replace(map_, rows=(name,) * len(map_.rows), groups=((block, count), ("time / s", count)))
    spec = specification(map_)
    for layout in (spec["layout"], spec["layout"] | spec["narrow"]):
        lines = layout["yaxis"]["ticktext"][0].split("<br>")
        assert "".join(lines).replace(" ", "") == name.replace(" ", "")
        assert 7 * max(map(len, lines)) <= layout["margin"]["l"]
        heading = layout["annotations"][0]["text"].split("<br>")
        assert " ".join(heading) == block
        assert len(heading) > 2 or layout is spec["layout"]


def test_missing_values_are_empty_in_csv():
    ((_, table),) = tables(samples.energy_map())
    assert any(line.split(",")[5] == "" for line in table.csv().splitlines())


@pytest.mark.parametrize(
    ("unit", "shown"),
    [("kg.m2", "kg·m²"), ("N.m.s/rad", "N·m·s/rad"), ("s-1", "s⁻¹"), ("1", ""), ("m/s2", "m/s²")],
)
def test_units_as_print_has_them(unit, shown):
    assert pretty_unit(unit) == shown


def test_thinning_keeps_the_extremes_and_only_recorded_samples():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=100_000), rng.normal(size=100_000)
    a[12_345], b[54_321] = 50.0, -50.0
    b[1000:2000] = np.nan
    keep = kept_samples([a, b], 4000)
    assert keep.size <= 4002
    assert {0, 12_345, 54_321, 99_999} <= set(keep.tolist())
    assert np.array_equal(kept_samples([a[:100]]), np.arange(100))


def test_milestones_are_improvements_between_start_and_best():
    cost = np.array([100.0, np.nan, 80, 90, 50, 60, 20, 10, 5, 5, 2, 1, 3])
    rows = milestones(cost, 3)
    assert rows == sorted(rows)
    assert len(rows) == 3
    assert all(cost[k] == np.nanmin(cost[: k + 1]) for k in rows)
    assert milestones(np.array([3.0, 2.0, 1.0])) == [1]
    assert milestones(np.array([3.0, 4.0])) == []


def test_parallel_coordinates_survive_a_search_that_failed_in_places():
    values = np.array([[1.0, 2.0], [1.0, 3.0], [1.0, 4.0]])
    stage = StageHistory("linear", ("a", "b"), values, np.array([3.0, np.nan, 1.0]))
    figure = parallel_figure(stage, {}, {"b": 5.0})
    assert figure.best == 2
    assert figure.scales[1].upper == 5.0
    assert render(figure)[:4] == b"\x89PNG"


def test_criteria_are_axes_of_parallel_coordinates():
    criteria = np.array([[8.0, 0.5, 3.0], [np.nan] * 3, [2.0, 0.8, 3.0]])
    stage = StageHistory(
        "s", ("a",), np.ones((3, 1)), np.array([3.0, np.nan, 1.0]), ("r: y", "r: z", "q: y"), criteria
    )
    figure = parallel_criteria_figure(stage)
    assert [s.axis.name for s in figure.scales] == ["r: y", "r: z", "q: y"]
    assert [(s.lower, s.upper, s.reference) for s in figure.scales] == [(1, 8, 1), (0.5, 1, 1), (1, 3, 1)]
    assert figure.best == 2
    assert render(figure)[:4] == b"\x89PNG"
    many = replace(
        stage, labels=tuple(f"r: {k}" for k in range(30)), criteria=np.tile(np.arange(30.0) + 1, (3, 1))
    )
    assert [s.axis.name for s in parallel_criteria_figure(many).scales] == [f"r: {k}" for k in range(20, 30)]


def test_many_figures_are_drawn_by_several_processes_all_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    monkeypatch.setattr("fmuid.report.plots._WORTH_A_PROCESS", 3)
    many = [replace(samples.ranked(), name=f"figure-{k}") for k in range(4)]
    save_figures(many, tmp_path)
    assert {p.read_bytes() for p in tmp_path.iterdir()} == {render(samples.ranked())}
    assert len(list(tmp_path.iterdir())) == 4


def test_a_helper_that_cannot_write_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    monkeypatch.setattr("fmuid.report.plots._WORTH_A_PROCESS", 3)
    monkeypatch.setattr("fmuid.report.plots.save_figure", lambda *_: None)  # only the helper tries
    (tmp_path / "file").write_text("")
    with pytest.raises(FmuidError, match="cannot be written"):
        save_figures([samples.ranked()] * 4, tmp_path / "file")


@pytest.mark.parametrize("text", ["=1+1", "+1", "@sum", "=cmd|' /C calc'!A0"])
def test_text_that_a_spreadsheet_would_run_is_escaped_in_csv(text):
    table = Table((text, "value"), ((text, 1.0), ("plain", None)))
    rows = list(csv.reader(io.StringIO(table.csv())))
    assert rows == [["'" + text, "value"], ["'" + text, "1"], ["plain", ""]]


def test_notes_of_bars_have_room_beside_them_and_are_below_them_on_a_phone():
    long, short = "probability below 0.001", "57.2"
    figure = BarFigure("b", "Bars", (Bar("a", 1.0, note=long), Bar("b", 0.1, note=short)), Axis("share"))
    spec = specification(figure)
    assert spec["layout"]["margin"]["r"] >= 8 + 6 * len(long)
    notes = [a for a in spec["narrow"]["annotations"] if a["text"] in (long, short)]
    assert [(note["xref"], note["x"], note["xanchor"]) for note in notes] == [("paper", 1, "right")] * 2
    assert "annotations" not in specification(replace(figure, bars=(Bar("a", 1.0, note=short),)))["narrow"]
