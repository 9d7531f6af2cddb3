"""Figures with made-up values, one of each kind."""

import numpy as np

from fmuid.report.diagnosis_figures import (
    Branch,
    DiagnosisPictures,
    ExcessEnergy,
    MissingQuantity,
    RegimeBins,
)
from fmuid.report.figures import Overlay, overlay_figure
from fmuid.report.plots.figure_data import (
    Axis,
    Bar,
    BarFigure,
    LineFigure,
    MapFigure,
    Panel,
    ParallelFigure,
    Scale,
    Series,
)

TIME = np.linspace(0, 0.2, 400)
TORQUE = Axis("tau_sensor", "N.m")


def step_response(damping):
    return 17.5 * (1 - np.exp(-damping * TIME) * np.cos(300 * TIME))


def history():
    rng = np.random.default_rng(1)
    series = [
        Series("measurement", TIME, step_response(40) + rng.normal(0, 0.2, TIME.size), "measurement"),
        Series("start", TIME, step_response(5), "start"),
        *(Series(f"evaluation {k}", TIME, step_response(5 + k), "iterate") for k in (4, 9, 20)),
        Series("final", TIME, step_response(40), "final"),
    ]
    panel = Panel("step_0p5", Axis("time", "s"), TORQUE, tuple(series))
    return LineFigure("history", "Optimisation history", (panel,), "Made up.")


def overlays(n=5):
    def overlay(k):
        simulated = (("simulation", "final", step_response(10 * k + 4)),)
        measured = step_response(10 * k + 5)
        return Overlay(f"step {k}", TORQUE.name, TORQUE.unit, TIME, measured, simulated, f"step {k}", 0.2)

    return overlay_figure("validation", "Validation", [overlay(k) for k in range(n)])


def friction():
    w = np.linspace(-300, 300, 201)
    law = np.sign(w) * (0.09 + 0.0002 * abs(w) + 0.05 * np.exp(-abs(w) / 10))
    at = np.array([-300, -150, -50, -20, 20, 50, 150, 300.0])
    series = (
        Series(
            "K_m mean(i_motor)",
            at,
            np.interp(at, w, law) + 0.002,
            "measurement",
            np.full(8, 0.003),
            points=True,
        ),
        Series("law, identified", w, law, "final"),
        Series("law, truth", w, law * 1.01, "reference"),
    )
    panel = Panel("Bearing friction", Axis("speed", "rad/s"), Axis("friction torque", "N.m"), series)
    return LineFigure("friction", "Bearing friction over speed", (panel,))


def correlation():
    c = np.array([[1, 0.2, -0.95], [0.2, 1, 0.1], [-0.95, 0.1, 1]])
    names = ("d_S", "J_S", "d_G")
    return MapFigure("correlation", "Correlation", names, names, c, Axis("correlation"), (-1.0, 1.0))


def energy_map():
    rng = np.random.default_rng(2)
    columns = tuple(f"{a}…{a + 5}" for a in range(-10, 10, 5)) * 3
    values = rng.uniform(0, 0.1, (8, 12))
    values[3, 4] = np.nan
    groups = (("speed / (rad/s)", 4), ("load torque / (N·m)", 4), ("frequency / Hz", 4))
    rows = tuple(f"run {k} · tau_sensor" for k in range(8))
    return MapFigure("excess", "Excess", rows, columns, values, Axis("share of excess energy"), (0.0, 0.1), groups)


def ranked():
    bars = (
        Bar("mesh_loss", 0.92, "final", (0.85, 0.97), "p = 0.97"),
        Bar("viscous", 0.3, "alternative", (0.1, 0.4), "p = 0.02"),
        Bar("spline of speed", -0.05, "floor", (-0.2, 0.1), "decoy"),
    )
    return BarFigure("effects", "Effects", bars, Axis("held-out closure"), ((0.0, "nothing closed"),))


def parallel():
    rng = np.random.default_rng(3)
    values = rng.uniform(0, 1, (60, 3)) * [5, 0.004, 100]
    best = np.array([2.66, 0.003039, 70.625])
    cost = 1 + (((values - best) / best) ** 2).sum(axis=1) * 100
    scales = (
        Scale(Axis("d_S", "N.m.s/rad"), 0, 5, 2.66),
        Scale(Axis("J_S", "kg.m2"), 0, 0.004, 0.003039),
        Scale(Axis("d_G", "N.m.s/rad"), 0, 100, 70.625),
    )
    return ParallelFigure("parallel", "Parallel coordinates", scales, values, cost, int(cost.argmin()))


ALL = (history, overlays, friction, correlation, energy_map, ranked, parallel)


def diagnosis():
    def effect(name, probability, held_out=None, spread=0.08):
        entry = {"id": name, "probability": probability}
        if held_out is not None:
            interval = [held_out - spread, held_out + spread]
            entry |= {
                "score": 40 * probability,
                "closure": {"train": held_out + 0.03, "held_out": held_out, "interval": interval},
                "parameters": {"eta1": {"value": 0.93, "standard_error": 0.004}},
            }
        return entry

    return {
        "format": "fmuid-diagnosis",
        "version": 3,
        "verdict": {
            "kind": "effect",
            "effects": ["mesh_loss"],
            "one_of": [],
            "port": "gear_friction",
            "ports": ["gear_friction"],
            "stable": True,
            "rest": None,
        },
        "gap": {
            "present": True,
            "p_value": 0.001,
            "nominal": 9.4,
            "nominal_refit": 6.1,
            "corrected": 0.35,
            "floor_units": {"tau_sensor": 0.1, "w_motor": 0.02},
        },
        "where": [
            {
                "experiment": "load_35p5",
                "signal": "tau_sensor",
                "regime": {"variable": "load torque", "from": 20.0, "to": 35.5, "unit": "N.m"},
                "share": 0.41,
            },
            {"experiment": "load_25", "signal": "tau_sensor", "share": 0.2},
        ],
        "effects": [
            effect("mesh_loss", 0.94, 0.93) | {"description": "Friction grows with the load"},
            effect("viscous", 0.02, 0.2),
            effect("stribeck", 0.01, 0.05),
            effect("hysteresis", 0.01, -0.1, 0.2),
        ],
        "answers": [
            {"effects": ["mesh_loss"], "probability": 0.94, "closure": effect("mesh_loss", 0.94, 0.93)["closure"]},
            {"effects": ["unknown"], "probability": 0.05, "closure": None},
            {"effects": ["none"], "probability": 0.01, "closure": None},
        ],
        "alias_classes": [["mesh_loss"], ["sensor_gain", "saturation"]],
        "hidden": {"unseen": ["backlash"], "imitated": ["sensor_offset"]},
        "model": {"parameters": {"d_S": 2.66, "lossTable[1,2]": 0.93}},
        "next_experiment": {
            "setup": "eccentric_load",
            "description": "largest load at 10 rad/s, both directions",
            "separation_sigma": 7.2,
            "between": ["mesh_loss", "viscous"],
        },
    }


def pictures():
    rng = np.random.default_rng(4)
    time = np.linspace(0, 50, 20_000)
    before = 2.0 * np.sin(0.3 * time) ** 3 + rng.normal(0, 0.1, time.size)
    after = rng.normal(0, 0.11, time.size)
    measured = 5.0 * np.sin(time)

    def overlay(experiment, signal, unit, over, *residuals, sigma=0.1):
        names = (("nominal, refitted", "before"), ("corrected", "after"))
        lines = tuple((*name, measured + r) for name, r in zip(names, residuals, strict=False))
        return Overlay(experiment, signal, unit, over, measured, lines, f"{experiment}: {signal}", sigma)

    worst = overlay("load_35p5", "tau_sensor", "N.m", time, before, after)
    fixed = overlay("prbs_0p8", "tau_sensor", "N.m", time / 100, after, after)
    free = overlay("free_100", "i_motor", "A", time / 10, after / 50, sigma=0.002)
    regimes = (
        RegimeBins(Axis("speed", "rad/s"), np.array([-30, -10, 0, 10, 30])),
        RegimeBins(Axis("load torque", "N.m"), np.array([-36, -12, 12, 36])),
        RegimeBins(Axis("frequency", "Hz"), np.array([0, 1, 10, 100, 1000])),
    )
    share = rng.uniform(0, 0.02, (4, 11))
    share[2] += 0.1
    excess = ExcessEnergy(
        tuple((e, "tau_sensor") for e in ("step_0p5", "load_25", "load_35p5", "free_100")), regimes, share
    )
    missing = []
    for name, unit, low, high in (
        ("speed", "rad/s", -30, 30),
        ("angle", "rad", 0, 6.28),
        ("load", "N.m", -36, 36),
    ):
        x = np.linspace(low, high, 13)
        y = 0.002 * abs(x)
        missing.append(
            MissingQuantity(
                Axis(name, unit),
                Axis("missing gear friction torque", "N.m"),
                (Branch(x, y + rng.normal(0, 0.003, 13), np.full(13, 0.004), (("mesh_loss", x, y),)),),
            )
        )
    return DiagnosisPictures((worst, fixed, free), excess, tuple(missing))
