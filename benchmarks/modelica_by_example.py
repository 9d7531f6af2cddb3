"""Models of M. Tiller's book "Modelica by Example": built, valid, simulated, and right where that is known.

    python -m benchmarks.modelica_by_example BOOK LIBRARY [--page docs/modelica_by_example.md]

`BOOK` is the folder of the book (with ``ModelicaByExample``, and ``text/specs.py``, which says how long the book
simulates what), `LIBRARY` that of the Modelica Standard Library 3.2.3, which the book uses. The book has no
reference results. Here they come from the models' equations, written down again and solved by SciPy or by hand,
for those models that belong to one of a dozen systems; they are compared as in `benchmarks.standard_library`.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from benchmarks.standard_library import in_a_process, outside

Signals = dict[str, np.ndarray]
Law = Callable[[np.ndarray], Signals]
STAGES = ("refused", "built", "valid", "simulated", "right")
LONGEST = 10.0  # seconds that a model without a stop time is simulated


def ode(rates: Callable[[float, np.ndarray], Sequence[float]], start: Sequence[float], *names: str) -> Law:
    """Reference solution of an initial value problem."""

    def law(t: np.ndarray) -> Signals:
        solution = solve_ivp(
            rates, (t[0], t[-1]), start, t_eval=t, rtol=1e-10, atol=1e-12, method="LSODA", max_step=0.05
        )
        return dict(zip(names, solution.y, strict=True))

    return law


def formula(**of_time: Callable[[np.ndarray], np.ndarray]) -> Law:
    """Reference solution by hand."""
    return lambda t: {name: np.broadcast_to(f(t), t.shape).astype(float) for name, f in of_time.items()}


def named(law: Law, *names: str) -> Law:
    """Return the same solution under other names of its variables."""
    return lambda t: dict(zip(names, law(t).values(), strict=True))


COOLING_RATE = 0.7 / 0.12


def cooling(at: float, start: float) -> Law:
    return formula(T=lambda t: at + (start - at) * np.exp(-COOLING_RATE * t))


def ambient(t: float) -> float:
    return 298.15 if t <= 0.5 else 298.15 - 20 * (t - 0.5)


def bounces(t: np.ndarray) -> Signals:
    height, fall = np.zeros_like(t), np.sqrt(2 / 9.81)
    begin, speed, end = 0.0, 0.0, fall
    for k in range(200):
        inside = (t >= begin) & (t < end)
        since = t[inside] - begin
        height[inside] = (1.0 if k == 0 else 0.0) + speed * since - 0.5 * 9.81 * since**2
        speed = 9.81 * fall * 0.8 ** (k + 1)
        begin, end = end, end + 2 * speed / 9.81
    return {"h": height}


def rod(_: float, temperature: np.ndarray) -> np.ndarray:
    section, surface = 3.14159 * 0.1**2, 2 * 3.14159 * 0.1
    flow = -2.0 * surface * (temperature - 300)
    between = 10 * section * np.diff(temperature) * 10
    flow[:-1] += between
    flow[1:] -= between
    return flow / (2.0 * section / 10 * 10)


def train(_: float, s: np.ndarray) -> list[float]:
    p1, p2, w1, w2 = s
    shaft = 11 * (p2 - p1) + 0.2 * (w2 - w1)
    return [w1, w2, shaft / 0.4, -shaft - 5 * p2 - w2]


def circuit(on: Callable[[float], float]) -> Callable[[float, np.ndarray], list[float]]:
    return lambda t, s: [(s[1] - s[0] / 100) / 1e-3, on(t) - s[0]]


RLC = ode(circuit(lambda _: 24.0), [0, 0], "V", "i_L")
SWITCHED = ode(circuit(lambda t: 24.0 if t > 0.5 else 0.0), [0, 0], "V", "i_L")
SMD = ode(train, [0, 1, 0, 0], "phi1", "phi2", "omega1", "omega2")
PREY = ode(lambda _, s: [s[0] * (0.1 - 0.02 * s[1]), s[1] * (0.02 * s[0] - 0.4)], [10, 10], "x", "y")
PREYED = ode(
    lambda _, s: [
        s[0] * (0.1 - 0.02 * s[1] - 0.02 * s[2]),
        s[1] * (0.02 * s[0] - 0.4 - 0.04 * s[2]),
        s[2] * (0.08 * s[1] + 0.01 * s[0] - 0.4),
    ],
    [25, 2, 4], "rabbits.species.population", "foxes.species.population", "wolves.species.population",
)  # fmt: skip
REACTION = ode(
    lambda _, c: [
        -0.1 * c[0] * c[1] + 0.1 * c[2],
        -0.1 * c[0] * c[1] + 0.1 * c[2] - 10 * c[1] * c[2],
        0.1 * c[0] * c[1] - 0.1 * c[2] - 10 * c[1] * c[2],
    ],
    [1, 1, 0], "cA", "cB", "cX",
)  # fmt: skip
FALLING = ode(lambda t, s: [COOLING_RATE * (ambient(t) - s[0])], [363.15], "T")
STEADY_FALLING = ode(lambda t, s: [COOLING_RATE * (ambient(t) - s[0])], [298.15], "T")
ROD = ode(rod, np.linspace(200, 300, 10), *(f"T[{i}]" for i in range(1, 11)))
PARABOLA = formula(yf=lambda t: t**2 - 2 * t + 2, yp=lambda t: t**2 - 2 * t + 2)
TENT = ode(lambda t, _: [max(0.0, 2 - abs(t - 4)) if 2 <= t <= 6 else 0.0], [0], "z")
WAVES = formula(x=lambda t: 2 * (np.floor(t) * 0.5 + np.minimum(t - np.floor(t), 0.5)))
INERTIAS = ("inertia1.phi", "inertia2.phi", "inertia1.w", "inertia2.w")
TWO = "rabbits.species.population", "foxes.species.population"
# By the end of a class name; the first that fits.
TRUTH: dict[str, Law] = {
    r"SimpleExample\.FirstOrder(Documented)?$": formula(x=lambda t: 1 - np.exp(-t)),
    r"SimpleExample\.FirstOrder(Initial|Experiment)$": formula(x=lambda t: 1 + np.exp(-t)),
    r"SimpleExample\.FirstOrderSteady$": formula(x=lambda t: np.ones_like(t)),
    r"CoolingExample\.NewtonCoolingWith(Types|Units)$": cooling(298.15, 363.15),
    r"CoolingExample\.NewtonCoolingWithDefaults$": cooling(25, 90),
    r"CoolingRevisited\.NewtonCoolingDynamic$": FALLING,
    r"CoolingRevisited\.NewtonCooling": STEADY_FALLING,
    r"HeatTransfer\.Examples\.Cooling(ToAmbient)?$": named(cooling(298.15, 363.15), "cap.node.T"),
    r"HeatTransfer\.Examples\.Adiabatic$": formula(**{"cap.node.T": lambda t: np.full_like(t, 363.15)}),
    r"BlockDiagrams\.Examples\.NewtonCooling$": named(cooling(298.15, 363.15), "T.y"),
    r"StateSpace\.Examples\.NewtonCooling$": named(cooling(27.5, 20), "x[1]"),
    r"StateSpace\.Examples\.RLC$": named(RLC, "rlc_comp.x[1]", "rlc_comp.x[2]"),
    r"StateSpace\.Examples\.RotationalSMD(_Concat)?$": named(SMD, "x[1]", "x[2]", "x[3]", "x[4]"),
    r"StateSpace\.Examples\.LotkaVolterra$": named(PREY, "x[1]", "x[2]"),
    r"StateSpace\.Examples\.FirstOrder(_Compact)?$": formula(**{"x[1]": lambda t: 1 - np.exp(-t)}),
    r"BasicEquations\.RLC\.RLC\d$": RLC,
    r"SwitchedRLC\.SwitchedRLC$": SWITCHED,
    r"RotationalSMD\.SecondOrderSystem(InitParams)?$": SMD,
    r"Rotational\.Examples\.SMD$": named(SMD, *INERTIAS),
    r"SpeedMeasurement\.Examples\.Plant": named(SMD, *INERTIAS),
    r"SpeedMeasurement\.(SampleAndHold|IntervalMeasure|CounterWithAlgorithm)$": SMD,
    r"BasicEquations\.LotkaVolterra\.ClassicModel": PREY,
    r"BasicEquations\.LotkaVolterra\.QuiescentModel$": formula(x=lambda t: 0 * t, y=lambda t: 0 * t),
    r"BasicEquations\.LotkaVolterra\.QuiescentModelWithMod": formula(
        x=lambda t: 30 + 0 * t, y=lambda t: 5 + 0 * t
    ),
    r"BasicEquations\.LotkaVolterra\.QuiescentModel": formula(x=lambda t: 20 + 0 * t, y=lambda t: 5 + 0 * t),
    r"LotkaVolterra\.Examples\.ClassicLotkaVolterra$": named(PREY, *TWO),
    r"LotkaVolterra\.Examples\.ThirdSpecies$": PREYED,
    r"BouncingBall\.BouncingBall$": bounces,
    r"Decay\.Decay3$": formula(x=lambda t: np.maximum(0, 1 - t / 2) ** 2),
    r"Decay\.Decay[45]$|Chatter\.With": formula(x=lambda t: np.maximum(1, 2 - t)),
    r"Hysteresis\.ChatteringControl$": formula(T=lambda t: np.maximum(295, 285 + 15 * np.exp(-2 * t))),
    r"PulseGenerator\.PulseGenerator$": formula(pulse=lambda t: np.floor(10 * t + 1e-9) % 2),
    r"Counter\.Counter$": formula(count=lambda t: np.floor(10 * t + 1e-9)),
    r"Accuracy\.With(No)?Events$": WAVES,
    r"ChemicalReactions\.Reactions_NoArrays$": REACTION,
    r"ChemicalReactions\.Reactions_(Array|Enum)": named(REACTION, "C[1]", "C[2]", "C[3]"),
    r"ChemicalReactions\.Examples\.ABX_System$": named(
        REACTION, "solution.C[1]", "solution.C[2]", "solution.C[3]"
    ),
    r"ArrayEquations\.HeatTransfer\.Rod_": ROD,
    r"Polynomials\.": PARABOLA,
    r"Nonlinearities\.ExplicitEvaluation$": formula(y=lambda t: 2 * t**2 + 3 * t + 1),
    r"Nonlinearities\.ImplicitEvaluation$": formula(y=lambda t: (np.sqrt(9 + 8 * t) - 3) / 4),
    r"Interpolation\.IntegrateInterpolatedVector$": TENT,
}
# What is known of those that are not simulated.
NOTES = {
    "ModelicaByExample.BasicEquations.CoolingExample.NewtonCooling": "the book gives its parameters no values, and"
    " the heat capacity is zero"
}


def models(book: Path) -> list[str]:
    """Return the complete models: examples, and those of the chapters whose models are all complete."""
    models = []
    for file in sorted((book / "ModelicaByExample").rglob("*.mo")):
        text = file.read_text(errors="replace")
        package = re.search(r"within ([\w.]+);", text)
        model = re.search(r"^\s*(?:encapsulated )?(partial )?(?:model|block)\s+(\w+)", text, re.M)
        if file.name == "package.mo" or not package or not model or model[1]:
            continue
        chapter = re.match(
            r"ModelicaByExample\.(BasicEquations|DiscreteBehavior|ArrayEquations|Functions)\b", package[1]
        )
        if ".Examples" in package[1] or "experiment" in text or chapter:
            models.append(f"{package[1]}.{model[2]}")
    return models


def stop_times(book: Path, names: Sequence[str]) -> tuple[dict[str, float], set[str]]:
    """How long the book simulates its models, the first time; and which fail there, as it explains."""
    out: dict[str, float] = {}
    failing: set[str] = set()
    for node in ast.walk(ast.parse((book / "text" / "specs.py").read_text())):
        if not isinstance(node, ast.Call) or getattr(node.func, "id", "") != "add_case":
            continue
        given = {k.arg: k.value for k in node.keywords}
        written = [str(c.value) for c in ast.walk(node.args[0]) if isinstance(c, ast.Constant)]
        patterns = [p.replace(r".\E", r"\.E") for p in written]  # a slip of the book's
        fitting = [n for n in names if all(re.search(p, n) for p in patterns)]
        stop = given.get("stopTime")
        if "mods" not in given and isinstance(stop, ast.Constant) and len(fitting) == 1:
            out.setdefault(fitting[0], float(stop.value))  # type: ignore[arg-type]
            failing |= set(fitting) if "simfails" in given else set()
    return out, failing


def judge(book: Path, library: Path, name: str, stop: float | None) -> dict[str, Any]:
    """Build, validate and simulate one model, and compare it with what is known."""
    import fmpy
    from fmpy.validation import validate_fmu

    from fmu_build import build
    from fmu_build.errors import BuildError, ModelicaError

    with tempfile.TemporaryDirectory() as out:
        try:
            fmu = build(book / "ModelicaByExample" / "package.mo", name, out, roots=[book, library])
        except (ModelicaError, BuildError) as error:
            return {"stage": "refused", "why": str(error)}
        problems = validate_fmu(str(fmu))
        if problems:
            return {"stage": "built", "why": " ".join(problems[0].split())}
        description = fmpy.read_model_description(str(fmu))
        default = description.defaultExperiment.stopTime if description.defaultExperiment else None
        end = stop or (float(default) if default else LONGEST)
        law = next((law for pattern, law in TRUTH.items() if re.search(pattern, name)), None)
        wanted = law(np.linspace(0.0, end, 4001)) if law else {}
        messages: list[str] = []
        try:
            result = fmpy.simulate_fmu(
                str(fmu), stop_time=end, output_interval=end / 1000, output=list(wanted) or None,
                relative_tolerance=1e-6, fmi_type="CoSimulation",
                logger=lambda *message: messages.append(message[-1].decode()),
            )  # fmt: skip
        except Exception as error:  # whatever the run ends with is its result
            return {"stage": "valid", "why": " ".join((messages or [str(error)])[0].split())}
    for signal, values in wanted.items():
        off = outside(result["time"], result[signal].astype(float), np.linspace(0.0, end, 4001), values)
        if not off <= 0.0:
            return {"stage": "simulated", "why": f"{signal} is {100 * off:.2g} % of its range outside the tube"}
    return {
        "stage": "right" if law else "simulated",
        "why": "" if law else f"to {end:g} s; nothing to compare it with",
    }


def page(results: dict[str, dict[str, Any]], shown: set[str]) -> str:
    """Make the page of the docs."""

    def row(what: str, of_package: list[dict[str, Any]]) -> str:
        counts = Counter(r["stage"] for r in of_package)
        reached = [sum(counts[s] for s in STAGES[k:]) for k in (1, 2, 3)]
        checked = [r for r in of_package if "nothing to compare" not in r["why"]]
        known = sum(r["stage"] == "right" for r in checked)
        wrong = sum(r["stage"] == "simulated" for r in checked)
        return f"| {what} | {len(of_package)} | {' | '.join(map(str, reached))} | {known} | {wrong} |"

    lines = [
        "# Modelica by Example", "",
        "How much Modelica `fmuid build` understands, measured on the models of a textbook.", "",
        "Every complete model of M. Tiller's book [Modelica by Example](https://mbe.modelica.university/):",
        "translated and built, valid (fmpy), simulated to the end for as long as the book simulates it (10 s if",
        "it does not). The book has no reference results: *right* are those whose variables lie inside a tube of",
        "0.2 % around a solution found without this compiler, by hand or by SciPy from the equations in the text,",
        "*wrong* those whose do not. For the others there is nothing to compare.",
        "`make modelica-by-example BOOK=FOLDER ROOT=FOLDER` makes this page.", "",
        "| models | number | built | valid | simulated | right | wrong |", "|---|---|---|---|---|---|---|",
        row("that the book simulates", [r for n, r in results.items() if n in shown]),
        row("all", list(results.values())),
        "", "## What is not simulated, or not right", "", "| model | reached | why |", "|---|---|---|",
    ]  # fmt: skip
    for name, result in results.items():
        if result["stage"] != "right" and "nothing to compare" not in result["why"]:
            why = result["why"].replace("|", "\\|")[:200] + (f"; {NOTES[name]}" if name in NOTES else "")
            lines.append(f"| `{name.removeprefix('ModelicaByExample.')}` | {result['stage']} | {why} |")
    lines += ["", "Next: [Modelica](modelica.md), or [how good it is](quality.md)."]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Judge all models of the book."""
    parser = argparse.ArgumentParser()
    parser.add_argument("book", type=Path)
    parser.add_argument("library", type=Path)
    parser.add_argument("--one")
    parser.add_argument("--stop", type=float)
    parser.add_argument("--limit", type=float, default=300.0)
    parser.add_argument("--page", type=Path)
    parser.add_argument("--results", type=Path, help="JSON file that results are added to, and taken from")
    options = parser.parse_args()
    if options.one:
        print(json.dumps(judge(options.book, options.library, options.one, options.stop)))
        return
    names = models(options.book)
    stops, failing = stop_times(options.book, names)
    results: dict[str, dict[str, Any]] = {}
    if options.results and options.results.is_file():
        results = json.loads(options.results.read_text())
    for name in names:
        if name in results:
            continue
        command = [sys.executable, "-m", "benchmarks.modelica_by_example", str(options.book), str(options.library)]
        command += ["--one", name, *(["--stop", str(stops[name])] if name in stops else [])]
        results[name] = in_a_process(command, options.limit)
        if name in failing:
            results[name]["why"] += " (as the book says)"
        print(name, *results[name].values(), flush=True)
        if options.results:
            options.results.write_text(json.dumps(results, indent=1))
    if options.page:
        options.page.write_text(page(dict(sorted(results.items())), set(stops)))


if __name__ == "__main__":
    main()
