"""The cases of the blind check: what each one is, as a function of seed and number, and its logs.

Four cases in a row are of one rig. Strata come in shuffled blocks of twenty, so that the first so many are a fair
sample. The first 100 cases of a seed are its rehearsal, the next 400 the check.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import lfilter

from benchmarks.blind.plants.effects import (
    Candidate,
    Effect,
    SignalEffect,
    Usual,
    candidates,
    gated,
    other_names,
    shaped,
    unknowns,
    usual,
    varying,
)  # fmt: skip
from benchmarks.blind.plants.grammar import KINDS_OF_WAVE, VERSION, Rig, controller_of, draw_rig, wave
from benchmarks.blind.plants.modelica import class_name, modelica, place_of
from benchmarks.blind.plants.network import Controller, DivergedError, Floats
from benchmarks.blind.plants.readings import MEMORY, Gaps, Run, Way, simulate

REHEARSAL, CHECK = 100, 400
PER_RIG = 4
_TWIN = 8  # of so many cases, the last one is the one before it in other units, with other columns beside
_BLOCK = ("none",) * 5 + ("one",) * 6 + ("two",) * 2 + ("varies",) * 2 + ("unknown",) * 3 + ("regime",) * 2
STRATA = tuple(dict.fromkeys(_BLOCK))
_EXPERIMENTS = (4, 4, 4, 4, 5, 5, 5, 6, 6, 7, 8)
_REPEATS = (1,) * 12 + (2,) * 3 + (3,) * 3 + (5,) * 2
_NOISE = ("white",) * 8 + ("coloured", "heteroscedastic", "quantised", "drift", "spikes", "inputs") * 2
_OWN_SHAPE, _LOUD = 0.12, 0.1  # shares: cases with the catalogue's own shape, with a background of a floor
_SUDDEN = ("saturation", "overflow")  # which leave nothing up to a size, and then much
_DAMAGE = ("truncated", "text", "order", "empty", "columns")
_BAD = 0.05  # of all files
_CONTAINED = {"weight": "imbalance"}  # laws whose expression another law of the catalogue has as a part
_UNITS = {
    "m": ("mm", 1e3), "rad": ("deg", 180 / np.pi), "V": ("mV", 1e3), "A": ("mA", 1e3), "N.m": ("kN.m", 1e-3),
    "Pa": ("kPa", 1e-3), "kg/s": ("g/s", 1e3), "W": ("kW", 1e-3), "N": ("kN", 1e-3),
}  # fmt: skip
_SIZED = (
    "viscous", "quadratic", "asymmetry", "weight", "coulomb", "leakage", "loss", "gain",
    "offset", "drift", "dead_zone", "lag", "delay",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A case: its rig, the plant's true values and effects, how it is recorded, and its label as JSON."""

    rig: Rig
    values: Mapping[str, float]
    effects: tuple[Effect | SignalEffect, ...]
    runs: tuple[Run, ...]
    names: tuple[str, ...]
    way: Way
    typical: Usual
    noise: str
    repeats: int
    controllers: tuple[tuple[Controller, Floats] | None, ...]
    label: Mapping[str, Any]
    rng: int
    columns: Mapping[str, Floats] = field(default_factory=dict)

    @property
    def number(self) -> int:
        """Of the case in its seed."""
        return int(self.label["number"])


def stratum_of(seed: int, number: int) -> str:
    """Return the stratum of a case."""
    block = np.random.default_rng([seed, number // len(_BLOCK), 3])
    return str(block.permutation(_BLOCK)[number % len(_BLOCK)])


def numbers(seed: int, first: int, count: int, only: str | None = None) -> list[int]:
    """Return the numbers of so many cases from the first one on: of all, or of one stratum and without twins."""
    every = (n for n in itertools.count(first) if n % _TWIN != _TWIN - 1 and stratum_of(seed, n) == only)
    return list(itertools.islice(every, count) if only else range(first, first + count))


def draw_case(seed: int, number: int, *, named: bool = True) -> Case:
    """Return case `number` of a seed; a plant that cannot be simulated is drawn again.

    Unless `named`, its label lacks the other names of its effects and their sizes, which take most of the time.
    """
    if number % _TWIN == _TWIN - 1:
        case = draw_case(seed, number - 1, named=named)
        units, columns = not case.label["units"], not case.label["columns"]
        changed = {"case": f"c{number:04d}", "number": number, "twin_of": case.label["case"], "damaged": []}
        return replace(case, label={**case.label, **changed, "units": units, "columns": columns})
    for attempt in range(50):
        try:
            return _drawn(seed, number, np.random.default_rng([seed, number, attempt, 5]), named=named)
        except (DivergedError, LookupError):
            continue
    raise DivergedError(f"no case {number} of seed {seed}")


def measured(case: Case) -> dict[str, Any]:
    """Return the gaps that refits to the end leave of a case: of all that the model lacks, and of parts of it.

    `alone` has an entry for every effect of the label, the others being known; `background` is that of the small
    effects alone.
    """
    gaps = Gaps(case.rig, case.values, case.runs, case.way, case.typical, "white")
    effects, background = np.split(np.array(case.effects, dtype=object), [len(case.label["effects"])])
    others = [[o for o in effects if o is not e] for e in effects]
    alone = [gaps.refitted([e], known) for e, known in zip(effects, others, strict=True)]
    left = {"gap": gaps.refitted([*case.effects]), "background": gaps.refitted([*background]), "alone": alone}
    return dict(_plain({**left, "determined": gaps.determined()}))


def _drawn(seed: int, number: int, rng: np.random.Generator, *, named: bool) -> Case:
    rig, stratum = draw_rig(seed, number // PER_RIG), stratum_of(seed, number)
    values = {n: float(f"{v * np.exp(rng.uniform(-0.2, 0.2)):.6g}") for n, v in rig.nominal.items()}
    repeats, noise = int(rng.choice(_REPEATS)), str(rng.choice(_NOISE))
    count = int(rng.choice(_EXPERIMENTS))
    kinds = [*rng.permutation(KINDS_OF_WAVE).tolist(), *rng.choice(KINDS_OF_WAVE, 4).tolist()][:count]
    moving, closed = bool(rng.random() < 0.2), bool(rng.random() < 0.2)
    timing = str(rng.choice(["held", "plc", "linear"], p=[0.7, 0.2, 0.1]))
    way = Way(float(rng.uniform(0.3, 1.0)) if timing == "plc" else 0.0, timing == "linear" and not closed)
    runs, controllers = [], []
    for kind in kinds:
        u = np.stack([wave(rng, s, rig.samples, kind, float(rng.uniform(0.6, 1.0))) for s in rig.inputs])
        runs.append(Run(u, rig.network.start(_moved(rig, rng) if moving else None), _ambient(rig, rng)))
        control = controller_of(rig, rng) if closed and rng.random() < 0.7 else None
        controllers.append(control)
    typical = usual(rig, runs[0].u)
    # Closed loops are driven open for the size of effects, by what their controllers do without noise.
    network = rig.with_values(values)
    for k, control in enumerate(controllers):
        if control is not None:
            _, u = simulate(
                rig, network, (), runs[k], way, typical, controller=control[0], reference=control[1],
                noise=np.zeros(rig.samples),
            )  # fmt: skip
            runs[k] = replace(runs[k], u=u)
    # Sizes are in standard deviations of a sample; which effects differ visibly depends on the noise.
    gaps = Gaps(rig, values, runs, way, typical, "white")
    telling = gaps if noise not in ("coloured", "drift") else Gaps(rig, values, runs, way, typical, noise)
    known = candidates(rig, typical, rng)
    try:
        chosen, label = _truth(rig, stratum, gaps, known, typical, rng)
    except LookupError:  # nothing of the kind is large enough on this rig
        stratum = "one"
        chosen, label = _truth(rig, stratum, gaps, known, typical, rng)
    background, behind, loud = [], [], bool(rng.random() < _LOUD)
    for_background = [c for c in known if c.id not in {x.id for x in chosen} and c.law not in _SUDDEN]
    wanted = 1.0 if loud else float(rng.uniform(0.1, 0.5))
    for k in rng.permutation(len(for_background))[: int(rng.integers(3, 7))]:
        small = shaped(for_background[k], rng)
        background.append(gaps.sized(small, 0.5 * wanted * float(rng.uniform(0.5, 1.5)))[0])
        behind.append(small.id)
    factor, low, high, total = 1.0, 0.0, np.inf, gaps.gap(background)
    for _ in range(8):  # together they may leave more or less than each of them promises
        if abs(total / wanted - 1.0) < 0.15:
            break
        low, high = (factor, high) if total < wanted else (low, factor)
        guess = factor * float(np.clip(wanted / total, 0.05, 5.0))
        factor = guess if low < guess < high else 0.5 * (low + high)
        total = gaps.gap([replace(b, size=b.size * factor) for b in background])
    background = [replace(b, size=b.size * factor) for b in background]
    effects = [c.effect for c in chosen]
    same, as_well, names = {}, {}, [*known, *other_names(rig, typical)]
    for one, name in zip(chosen, label["effects"], strict=True) if named else ():
        same[name], as_well[name] = telling.twins_of(one.effect, names, repeats, one.id)
        if one.law in _CONTAINED and rig.network.nodes[one.effect.where].domain == "rotational":
            same[name].append(f"{_CONTAINED[one.law]}@{one.place}")
    twins = {n for b in background for n in telling.twins_of(b, names, repeats)[0]} if named else set()
    background_same = sorted(twins - set(behind))
    together = gaps.gap(effects, background) if effects else 0.0
    if not np.isfinite(together) or abs(total / wanted - 1.0) > 0.3 or (effects and together < 0.95):
        raise DivergedError(f"effects and background leave {together:.2g} and {total:.2g} floors")
    for run, control in zip(runs, controllers, strict=True):
        simulate(
            rig, network, [*effects, *background], run, way, typical, controller=control[0] if control else None,
            reference=control[1] if control else None, noise=np.zeros(rig.samples),
        )  # fmt: skip
    label |= {
        "case": f"c{number:04d}", "number": number, "seed": seed, "grammar": VERSION, "rig": rig.number,
        "kind": rig.kind, "components": rig.components, "style": rig.style, "stratum": stratum, "same": same,
        "as_well": as_well,
        "gap": together, "background": total, "loud": loud, "background_effects": behind,
        "repeats": repeats, "noise": noise, "experiments": count, "timing": timing, "moving": moving,
        "closed": sum(c is not None for c in controllers), "values": values,
        "damaged": rng.choice(_DAMAGE, rng.binomial(count * repeats, _BAD)).tolist(),
        "twin_of": None, "columns": bool(rng.random() < 0.4), "units": bool(rng.random() < 0.15),
        "background_same": background_same, "sizes": _sizes(gaps, chosen, known) if named else {},
    }  # fmt: skip
    if stratum == "regime":
        label["regime"] |= _regime_traces(rig, network, runs, way, typical, effects, label["regime"])
    names = tuple(f"{kind}_{k + 1}" for k, kind in enumerate(kinds))
    return Case(
        rig, values, (*effects, *background), tuple(runs), names, way, typical, noise, repeats,
        tuple(controllers), _plain(label), int(rng.integers(2**31)),
    )  # fmt: skip


def _moved(rig: Rig, rng: np.random.Generator) -> dict[int, float]:
    moved = {}
    for k, node in enumerate(rig.network.nodes):
        if node.driven < 0:
            by = float(rng.uniform(-0.5, 0.5)) * rig.scale[node.domain]
            moved[k] = 0.5 * by if node.domain == "tank" else by
    return moved


def _ambient(rig: Rig, rng: np.random.Generator) -> Floats:
    """Return a slow course between 0 and 1: of the surroundings, logged as a temperature."""
    t = np.linspace(0.0, 1.0, rig.samples)
    x = sum(np.sin(2 * np.pi * (f * t + rng.uniform())) for f in (0.3, 0.7, 1.3)) / 6 + 0.5
    return np.round(x, 3)[None, :]


def _truth(
    rig: Rig, stratum: str, gaps: Gaps, known: Sequence[Candidate], typical: Usual, rng: np.random.Generator
) -> tuple[list[Candidate], dict[str, Any]]:
    """Draw the effects of a case at their sizes; return them and the beginning of the label."""
    wanted = {"none": 0, "two": 2}.get(stratum, 1)
    own_shape = stratum == "one" and bool(rng.random() < _OWN_SHAPE)
    chosen: list[Candidate] = []
    label: dict[str, Any] = {"effects": [], "shapes": [], "gaps": [], "own_shape": own_shape}
    pool: list[Candidate] = list(known)
    if stratum == "unknown":
        pool = unknowns(rig, typical, rng)
    elif stratum == "regime":
        pool = [
            c
            for c in known
            if isinstance(c.effect, Effect)
            and c.effect.target == "node"
            and c.law not in ("capacity", "overflow", "presliding")
        ]
    variables = {}
    if stratum == "varies":
        vary = varying(rig, typical, rng)
        variables = {id(v.candidate): v for v in vary}
        pool = [v.candidate for v in vary]
    while len(chosen) < wanted:
        if not pool:
            raise LookupError("no effect is large enough on this rig")
        # By law first, so that no law is frequent because it may act in many places.
        law = str(rng.choice(sorted({c.law for c in pool})))
        one = [c for c in pool if c.law == law]
        candidate = one[int(rng.integers(len(one)))]
        pool = [c for c in pool if c is not candidate]
        drawn = shaped(candidate, rng, own_shape=own_shape)
        if stratum == "regime":
            drawn = gated(drawn, typical, rng)
        sign = float(rng.choice([-1.0, 1.0])) if candidate.two_sided else 1.0
        target = float(10.0 ** rng.uniform(0.0, 1.0))
        effect, gap = gaps.sized(drawn, target, sign)
        if not 0.95 <= gap < 3.0 * target or any(c.id == candidate.id for c in chosen):
            continue
        if chosen and min(gaps.gap([effect], [chosen[0].effect]), gaps.gap([chosen[0].effect], [effect])) < 0.95:
            continue
        chosen.append(replace(drawn, effect=effect))
        label["effects"].append(candidate.id if stratum != "varies" else f"varies@{candidate.place}")
        label["shapes"].append(effect.shape)
        label["gaps"].append(gap)
        if stratum == "varies":
            label["variable"] = list(variables[id(candidate)].variable)
            label["source"] = ("potential", "column", "time", "state", "memory")[
                variables[id(candidate)].candidate.effect.source
            ]
        if isinstance(effect, Effect):
            element = effect.target != "node"
            label.setdefault("places", []).append(place_of(rig, "element" if element else "node", effect.where))
            if stratum == "regime":
                what = "rate" if abs(effect.gate) > 1.5 else "potential"
                regime = {"node": effect.where, "place": candidate.place, "what": what, "over": effect.threshold}
                label["regime"] = regime
        else:
            label.setdefault("places", []).append(candidate.place)
    return chosen, label


def _sizes(gaps: Gaps, chosen: Sequence[Candidate], known: Sequence[Candidate]) -> dict[str, float]:
    """Return by id the size that the catalogue's own law has to take for an effect, where that is one number."""
    sizes = {}
    for candidate in chosen:
        if candidate.law not in _SIZED or (isinstance(candidate.effect, Effect) and candidate.effect.gate):
            continue
        plain = next((c for c in known if c.id == candidate.id), None)
        if plain is None:
            continue
        effect = plain.sized(gaps.fitted(gaps.readings({}, [candidate.effect]), plain)[1])
        value = effect.size
        if isinstance(effect, SignalEffect):
            scale = (gaps.typical.inputs if effect.is_input else gaps.typical.outputs)[effect.index]
            dt, duration = gaps.rig.dt, gaps.rig.dt * (gaps.rig.samples - 1)
            value *= {"gain": 1.0, "lag": dt, "delay": dt, "drift": scale / duration}.get(effect.law, scale)
            value += 1.0 if effect.law == "gain" else 0.0
        sizes[candidate.id] = float(value)
    return sizes


def _regime_traces(
    rig: Rig,
    network: Any,
    runs: Sequence[Run],
    way: Way,
    typical: Usual,
    effects: Sequence[Any],
    regime: Mapping[str, Any],
) -> dict[str, Any]:
    """Return every fourth sample of the regime's variable over the runs, and the share of them inside it."""
    node = regime["node"]
    whole = replace(rig, network=replace(rig.network, readings=(("potential", node),)))
    inner = [e for e in effects if isinstance(e, Effect)]
    seen = []
    for run in runs:
        y, _ = simulate(whole, replace(network, readings=(("potential", node),)), inner, run, way, typical)
        seen += y[0][::4].tolist()
    x = np.array(seen)
    inside = (np.abs(x) if regime["what"] == "rate" else x) > regime["over"]
    return {"trace": [float(f"{v:.4g}") for v in x], "share": float(inside.mean())}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    return float(f"{value:.6g}") if isinstance(value, float) else value


# Logs -----------------------------------------------------------------------------------------------------------


def noisy(y: Floats, sigma: Floats, noise: str, rng: np.random.Generator) -> Floats:
    """Return readings with noise of a kind."""
    white = rng.normal(size=y.shape)
    if noise == "coloured":
        keep = np.exp(-1.0 / MEMORY)
        white[:, 1:] *= np.sqrt(1.0 - keep**2)
        return y + lfilter([1.0], [1.0, -keep], white, axis=1) * sigma
    if noise == "heteroscedastic":
        far = np.abs(y - y[:, :1])
        return y + white * sigma * (0.4 + 1.6 * far / np.maximum(far.max(axis=1, keepdims=True), 1e-300))
    if noise == "quantised":
        return 3.0 * sigma * np.round((y + 0.05 * white * sigma) / (3.0 * sigma))
    if noise == "drift":
        level = rng.normal(size=(len(y), 1)) + rng.normal(size=(len(y), 1)) * np.linspace(0.0, 1.0, y.shape[1])
        return y + (white + level) * sigma
    if noise == "spikes":
        where = rng.random(y.shape) < 0.004
        return y + (white + where * rng.uniform(10.0, 40.0, y.shape) * rng.choice([-1.0, 1.0], y.shape)) * sigma
    return y + white * sigma


def bad_file(k: int) -> str:
    """Return the name of a damaged log: a further recording of one of the runs."""
    return f"aborted_{k + 1}"


def write_case(case: Case, folder: Path) -> dict[str, str]:
    """Write what a user has; return SHA-256 of every log by name."""
    rig, label = case.rig, case.label
    folder.mkdir(parents=True, exist_ok=True)
    network, sigma = rig.with_values(case.values), np.array(rig.noise)[:, None]
    logs, hashes = [], {}

    def record(name: str, k: int, damage: str | None = None) -> None:
        run, control, rng = case.runs[k], case.controllers[k], np.random.default_rng([case.rng, len(logs)])
        feedback = rng.normal(size=rig.samples) * rig.noise[control[0].output] if control else None
        y, u = simulate(
            rig, network, case.effects, run, case.way, case.typical,
            controller=control[0] if control else None, reference=control[1] if control else None, noise=feedback,
        )  # fmt: skip
        read = noisy(y, sigma, case.noise, rng)
        if case.noise == "inputs":
            u = u + rng.normal(size=u.shape) * 3e-3 * np.ptp(u, axis=1, keepdims=True)
        text = _table(case, run, u, read, control, rng)
        file = folder / f"{name}.csv"
        file.write_text(_damaged(text, damage) if damage else text, encoding="utf-8")
        hashes[file.name] = hashlib.sha256(file.read_bytes()).hexdigest()
        logs.append(file.name)

    for k, name in enumerate(case.names):
        for again in range(case.repeats):
            record(f"{name}_{again + 1}", k)
    for k, damage in enumerate(label["damaged"]):
        record(bad_file(k), k % len(case.runs), damage)
    (folder / f"{class_name(rig)}.mo").write_text(modelica(rig), encoding="utf-8")
    # A user knows about how exact the model has to be: to a noise floor.
    tolerance = {s.name: f"{n:.3g} {s.unit}" for s, n in zip(rig.outputs, rig.noise, strict=True)}
    order = {"logs": logs, "model": f"{class_name(rig)}.mo", "class": class_name(rig), "tolerance": tolerance}
    (folder / "order.json").write_text(json.dumps(order, indent=1) + "\n", encoding="utf-8")
    return hashes


def _table(
    case: Case, run: Run, u: Floats, y: Floats, control: tuple[Controller, Floats] | None, rng: np.random.Generator
) -> str:
    rig, label = case.rig, case.label
    begin = float(rng.integers(1, 500)) * rig.dt if label["moving"] else 0.0
    columns = [("time", "s", begin + np.arange(rig.samples) * rig.dt)]
    columns += [(s.name, s.unit, x) for s, x in zip(rig.inputs, u, strict=True)]
    columns += [(s.name, s.unit, x) for s, x in zip(rig.outputs, y, strict=True)]
    if label.get("source") == "column" or label["columns"]:
        assert run.columns is not None
        columns.append(("T_ambient", "degC", 20.0 + 10.0 * run.columns[0]))
    if label["columns"]:
        columns.append(("supply_bus", "V", 24.0 + 0.05 * rng.normal(size=rig.samples)))
        columns.append(("cycle", "1", np.arange(rig.samples) % 100.0))
    if control is not None:
        columns.append(("setpoint", "1", control[1]))
    head, rows = [], []
    for name, unit, x in columns:
        other, factor = (
            _UNITS.get(unit, (unit, 1.0)) if label["units"] and name not in ("time", "supply_bus") else (unit, 1.0)
        )
        head.append(f"{name} [{other}]")
        rows.append(np.asarray(x) * factor)
    lines = [",".join(f"{v:.7g}" for v in row) for row in np.array(rows).T]
    return "\n".join([",".join(head), *lines]) + "\n"


def _damaged(text: str, how: str) -> str:
    lines = text.splitlines()
    if how == "truncated":
        return "\n".join(lines[: len(lines) // 2]) + "\n" + lines[len(lines) // 2][:7]
    if how == "text":
        cells = lines[20].split(",")
        return "\n".join([*lines[:20], ",".join([cells[0], "#REF!", *cells[2:]]), *lines[21:]]) + "\n"
    if how == "order":
        return "\n".join([*lines[:30], *lines[60:90], *lines[30:60], *lines[90:]]) + "\n"
    if how == "empty":
        return lines[0] + "\n"
    return "\n".join(line.rpartition(",")[0] if k % 2 else line for k, line in enumerate(lines)) + "\n"
