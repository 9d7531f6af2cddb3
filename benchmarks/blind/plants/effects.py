"""What a plant has beyond its model: laws near the catalogue's at nodes, in branches and at signals, and others.

Shape 0 of a law is the catalogue's own; the others are not (see ``network.c`` and `SignalEffect`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.blind.plants.grammar import Rig
from benchmarks.blind.plants.modelica import place_of
from benchmarks.blind.plants.network import Effect, Floats

SHAPES = {
    "viscous": 2, "coulomb": 3, "stribeck": 3, "asymmetry": 2, "quadratic": 2, "presliding": 3, "cogging": 3,
    "weight": 2, "hardening": 3, "hysteresis": 3, "backlash": 2, "leakage": 2, "capacity": 2, "loss": 3,
    "radiation": 2, "outflow": 2,
    "overflow": 2, "voltage_drop": 3, "eddy": 2, "gain": 2, "offset": 2, "drift": 2, "lag": 3,
    "delay": 2, "saturation": 3, "dead_zone": 3, "crosstalk": 2, "coefficient": 4,
}  # fmt: skip
UNKNOWN = ("resonator", "wear", "pulsation", "relay", "chaos", "slip")
_TWO_SIDED = ("gain", "offset", "drift", "crosstalk", "asymmetry", "cogging", "weight", "coefficient", "varies")
_MECHANICAL = ("stribeck", "coulomb", "asymmetry", "quadratic", "presliding", "weight", "viscous", "cogging")
AT_INPUTS = ("gain", "offset", "delay", "lag", "saturation", "dead_zone")
AT_OUTPUTS = ("gain", "offset", "drift", "lag", "delay", "crosstalk")
_PARTS = 8  # of a sample, in which late signals are followed
# Largest plausible sizes, in units:
_MOST = {"gain": 4.0, "saturation": 8.0, "dead_zone": 6.0, "coefficient": 8.0, "varies": 100.0}


@dataclass(frozen=True)
class SignalEffect:
    """A device at an input or output; `size` in units of the signal's usual range, of times in samples."""

    law: str
    shape: int
    is_input: bool
    index: int
    size: float
    other: int = 0  # of crosstalk: the output that couples in

    def applied(self, y: Floats, all_: Floats, scale: float, zero: float) -> Floats:
        """Return the signal as it is read or acts; `scale` and `zero` are its usual range and start."""
        t, s = np.linspace(0.0, 1.0, len(y)), self.size * scale
        x, limit = y - zero, scale / (1.0 + self.size)
        match self.law, self.shape:
            case "gain", 0:
                return y * (1.0 + self.size)
            case "gain", 1:
                return y * (1.0 + self.size * (1.0 + 0.1 * x / scale))
            case "gain", _:
                return y * (1.0 + self.size * (1.0 + 0.1 * np.tanh(3.0 * x / scale)))
            case "offset", 0:
                return y + s
            case "offset", 1:
                return y + s * (1.0 + 0.1 * np.exp(-8.0 * t))
            case "offset", _:
                return y + s * (1.0 + 0.05 * np.sin(3.0 * t))
            case "drift", 0:
                return y + s * t
            case "drift", 1:
                return y + s * (1.0 - np.exp(-2.0 * t)) / (1.0 - np.exp(-2.0))
            case "drift", _:
                return y + s * t**1.3
            case "saturation", 0:
                return zero + x / (1.0 + np.abs(x / limit) ** 5) ** 0.2
            case "saturation", 1:  # a knee, beyond which a twentieth of it goes on
                return zero + np.clip(x, -limit, limit) + 0.05 * (x - np.clip(x, -limit, limit))
            case "saturation", 2:
                return zero + limit * np.tanh(x / limit)
            case "saturation", _:
                return zero + np.clip(x, -1.1 * limit, limit)
            case "dead_zone", 0:
                return y - np.clip(y, -s, s)
            case "dead_zone", 1:
                return y - s * np.tanh(y / s) if s else y
            case "dead_zone", 2:
                return y - np.clip(y, -0.8 * s, 1.2 * s)
            case "dead_zone", _:
                return y - 0.95 * np.clip(y, -s, s)
            case "crosstalk", _:
                one = all_[self.other]
                late = _late(one, 0.5, 0) if self.shape == 1 else one
                far = (one - one[0]) / max(np.ptp(one), 1e-300)
                return y + self.size * late * (1.0 + 0.1 * np.tanh(far) if self.shape == 2 else 1.0)
            case "lag", _:
                return _late(y, self.size * _PARTS, self.shape)
            case "delay", _:
                return _delayed(y, self.size * _PARTS, self.shape)
        raise ValueError(self.law)


def _late(y: Floats, steps: float, shape: int) -> Floats:
    """Return a signal behind a filter whose delay at low frequencies is so many steps."""
    if steps <= 0:
        return y
    if shape == 3:  # a moving mean
        width = max(round(2 * steps), 1)
        padded = np.concatenate([np.full(width - 1, y[0]), y])
        total = np.cumsum(np.concatenate([[0.0], padded]))
        mean = (total[width:] - total[:-width]) / width
        share = 2 * steps / width
        return share * mean + (1 - share) * y
    orders = {0: (1.0,), 1: (0.5, 0.5), 2: (0.75, 0.25)}[shape]
    for part in orders:
        keep = np.exp(-1.0 / (part * steps))
        out = np.empty_like(y)
        last = y[0]
        # What is held from step to step is followed exactly.
        for k in range(len(y)):
            out[k] = last
            last = y[k] + (last - y[k]) * keep
        y = out
    return y


def _delayed(y: Floats, steps: float, shape: int) -> Floats:
    if shape == 1:  # a dead time and a small lag
        return _late(np.interp(np.arange(len(y)) - 0.85 * steps, np.arange(len(y)), y), 0.15 * steps, 0)
    if shape == 2:  # it wanders
        k = np.arange(len(y))
        return np.interp(k - steps * (1.0 + 0.1 * np.sin(2 * np.pi * 3.3 * k / len(y))), k, y)
    return np.interp(np.arange(len(y)) - steps, np.arange(len(y)), y)


@dataclass(frozen=True)
class Usual:
    """What is usual on a rig: by node range of potential, of position, by element of its state, by signal."""

    potential: Floats
    position: Floats
    state: Floats
    inputs: Floats
    outputs: Floats
    zeros: Floats  # of outputs, at the start


def usual(rig: Rig, u: Floats) -> Usual:
    """Return the usual ranges of a rig driven by `u`."""
    network = rig.network
    everything = [("potential", k) for k in range(len(network.nodes))]
    everything += [("position", k) for k in range(len(network.nodes))]
    everything += [("state", k) for k in range(len(network.elements))]
    whole = replace(network, readings=tuple(everything))
    y, _ = whole.run(rig.dt, u, whole.steps(rig.dt, u[:, 0]))
    n = len(network.nodes)
    far = np.maximum(np.abs(y - y[:, :1]).max(axis=1), 1e-300)
    out, _ = network.run(rig.dt, u, network.steps(rig.dt, u[:, 0]))
    return Usual(
        far[:n],
        far[n : 2 * n],
        far[2 * n :],
        np.abs(u).max(axis=1),
        np.maximum(np.ptp(out, axis=1), 1e-300),
        out[:, 0],
    )


@dataclass(frozen=True)
class Candidate:
    """Something that may act on a plant, at unit size."""

    law: str
    place: str
    effect: Effect | SignalEffect

    @property
    def id(self) -> str:
        """As a diagnosis writes it."""
        return f"{self.law}@{self.place}"

    def sized(self, size: float) -> Effect | SignalEffect:
        """Return it at a multiple of unit size."""
        return replace(self.effect, size=size * self.effect.size)

    @property
    def most(self) -> float:
        """The largest plausible size."""
        return _MOST.get(self.law, 30.0)

    @property
    def two_sided(self) -> bool:
        """Whether the other sign is as plausible."""
        return self.law in _TWO_SIDED


def candidates(rig: Rig, typical: Usual, rng: np.random.Generator) -> list[Candidate]:
    """Return the effects that may act on a rig, each in shape 0 and with drawn numbers of its shape."""
    drawn = []
    for k, node in enumerate(rig.network.nodes):
        if node.driven < 0:
            drawn += [_at_node(rig, typical, rng, k, law) for law in _laws_at(rig, k)]
    for k, element in enumerate(rig.network.elements):
        if element.kind in ("spring", "gear") and element.b >= 0:
            drawn += [_in_spring(rig, typical, rng, k, law) for law in ("hardening", "hysteresis", "backlash")]
        if element.kind in ("coil", "motor"):
            drawn += [
                _in_coil(rig, typical, rng, k, law)
                for law in ("voltage_drop", "eddy")
                if (element.kind, law) != ("motor", "eddy")
            ]
    for is_input, signals, laws_here in ((True, rig.inputs, AT_INPUTS), (False, rig.outputs, AT_OUTPUTS)):
        for k, signal in enumerate(signals):
            for law in laws_here:
                if law == "crosstalk" and len(rig.outputs) < 2:
                    continue
                size = {"lag": 1.0, "delay": 1.0}.get(law, 0.1)
                other = (k + 1) % max(len(rig.outputs), 1)
                if law == "crosstalk":
                    size *= typical.outputs[k] / typical.outputs[other]
                drawn.append(Candidate(law, signal.name, SignalEffect(law, 0, is_input, k, size, other)))
    return drawn


def _laws_at(rig: Rig, k: int) -> list[str]:
    node = rig.network.nodes[k]
    here = [e for e in rig.network.elements if k in (e.a, e.b)]
    grounded = {e.kind for e in here if e.b < 0}
    if node.mechanical:
        laws = _MECHANICAL if node.domain == "rotational" else _MECHANICAL[:-1]
        has = {"dry": ("coulomb",), "drag": ("quadratic",), "cond": ("viscous",)}
        return [law for law in laws if not any(law in has.get(kind, ()) for kind in grounded)]
    laws = {
        "electrical": ["leakage", "capacity"], "thermal": ["loss", "radiation", "capacity"],
        "hydraulic": ["capacity"], "tank": ["outflow", "overflow", "leakage"],
    }[node.domain]  # fmt: skip
    if "cond" in grounded:
        laws = [law for law in laws if law not in ("leakage", "loss")]
    if "valve" in grounded:
        laws = [law for law in laws if law != "outflow"]
    return laws


def _at_node(rig: Rig, typical: Usual, rng: np.random.Generator, k: int, law: str) -> Candidate:
    node = rig.network.nodes[k]
    f, p, far, t = rig.thrust[node.domain], typical.potential[k], typical.position[k], rig.time
    size = 0.1 * f * {
        "viscous": 1 / p, "quadratic": 1 / p**2, "leakage": 1 / p, "loss": 1 / p, "capacity": t / p,
        "outflow": max(p, node.start) ** -0.5, "overflow": 5 / p,
    }.get(law, 1.0)  # fmt: skip
    order = float(rng.integers(2, 9)) if far > 2.0 else float(np.ceil(rng.uniform(8.0, 20.0) / far))
    s1 = {
        "stribeck": rng.uniform(0.1, 0.4) * p, "presliding": rng.uniform(0.01, 0.06) * far,
        "cogging": min(order, max(0.35 * np.pi / (rig.dt * p), 1.0)), "weight": float(node.domain == "rotational"),
        "capacity": rng.uniform(0.5, 3.0) * t, "overflow": node.start + rng.uniform(0.4, 0.8) * p,
        "resonator": rng.uniform(3.0, 9.0) / t, "relay": rng.uniform(0.1, 0.4) * t,
        "chaos": rng.uniform(0.3, 0.8) * t,
        "slip": rng.uniform(0.35, 0.65), "pulsation": rng.uniform(4.0, 14.0),
    }.get(law, 0.0)  # fmt: skip
    s2 = float(rng.uniform(0.0, 6.0)) if law in ("cogging", "pulsation") else 0.0
    zero = 0.0 if node.domain == "tank" and law in ("leakage", "outflow", "overflow") else node.start
    scale = far if node.mechanical else p
    effect = Effect(law, 0, "node", k, float(size), float(s1), s2, float(scale), float(p), float(zero))
    return Candidate(law, place_of(rig, "node", k), effect)


def _in_spring(rig: Rig, typical: Usual, rng: np.random.Generator, k: int, law: str) -> Candidate:
    e = rig.network.elements[k]
    stiff = e.p[1] if e.kind == "gear" else e.p[0]
    twist = typical.state[k]
    size = 0.1 * twist if law == "backlash" else 0.1 * stiff * twist
    target = "drop" if law == "backlash" else "beside"
    s1 = float(rng.uniform(0.1, 0.4) * twist) if law == "hysteresis" else 0.0
    effect = Effect(law, 0, target, k, float(size), s1, 0.0, float(twist), float(twist / rig.time))
    return Candidate(law, place_of(rig, "element", k), effect)


def _in_coil(rig: Rig, typical: Usual, rng: np.random.Generator, k: int, law: str) -> Candidate:
    volts, amperes = rig.scale["electrical"], typical.state[k]
    if law == "voltage_drop":
        effect = Effect(law, 0, "drop", k, 0.1 * volts, scale=float(amperes))
    else:
        lag = float(rng.uniform(0.05, 0.3) * rig.time)
        effect = Effect(law, 0, "drop", k, 0.1 * volts / float(amperes), lag, scale=float(amperes))
    return Candidate(law, place_of(rig, "element", k), effect)


# Coefficients that vary, and what no catalogue has ---------------------------------------------------------------


@dataclass(frozen=True)
class Varying:
    """A coefficient that varies: the candidate, its parameter, and the names of what it varies with."""

    candidate: Candidate
    parameter: str
    variable: tuple[str, ...]


def other_names(rig: Rig, typical: Usual) -> list[Candidate]:
    """Return coefficients that vary as other names of laws; with a speed, as itself and as its magnitude."""
    names = []
    for one in varying(rig, typical, np.random.default_rng(0), friction=True):
        effect, name = one.candidate.effect, f"{one.parameter}({one.variable[-1]})"
        assert isinstance(effect, Effect)
        turning = effect.source == 0 and rig.network.nodes[effect.index].mechanical
        names += [Candidate("varies", name, replace(effect, shape=k)) for k in ((0, 5) if turning else (0,))]
    return names


def varying(rig: Rig, typical: Usual, rng: np.random.Generator, *, friction: bool = False) -> list[Varying]:
    """Return coefficients of branches, each with what it may vary with; of `friction`, also with its speed."""
    places = []
    for parameter in rig.parameters:
        what, k, j = parameter.slot
        if what != "element":
            continue
        element = rig.network.elements[k]
        near = [n for n in (element.a, element.b, element.c) if n >= 0 and rig.network.nodes[n].driven < 0]
        sources: list[tuple[int, int, float, float, tuple[str, ...]]] = [
            (2, 0, 0.0, 1.0, ("time",)),
            (1, 0, 0.0, 1.0, ("ambient",)),
        ]
        for n in near:
            node = rig.network.nodes[n]
            if friction or not (node.mechanical and element.kind in ("cond", "dry", "drag")):
                names = (place_of(rig, "node", n).removesuffix(".balance"), node.name)
                sources.append((0, n, node.start, float(typical.potential[n]), names))
        if element.kind in ("coil", "motor"):
            sources.append(
                (3, k, 0.0, float(typical.state[k]), ("current", f"i_{element.name}", f"{element.name}.i"))
            )
            sources.append((4, k, 0.0, float(typical.state[k]), ("memory", "warming")))
        for source, index, zero, scale, names in sources:
            s1 = float(rng.uniform(0.1, 0.4) * rig.dt * rig.samples) if source == 4 else 0.0
            effect = Effect(
                "coefficient", 0, "varies", k, 0.1, s1, float(j), scale, 1.0, zero, source=source, index=index
            )
            places.append(Varying(Candidate("coefficient", parameter.name, effect), parameter.name, names))
    return places


def unknowns(rig: Rig, typical: Usual, rng: np.random.Generator) -> list[Candidate]:
    """Return effects outside the catalogue, at the stores of a rig."""
    free = [k for k, n in enumerate(rig.network.nodes) if n.driven < 0]
    return [_at_node(rig, typical, rng, k, law) for k in free for law in UNKNOWN]


def shaped(candidate: Candidate, rng: np.random.Generator, *, own_shape: bool = False) -> Candidate:
    """Return a candidate with a drawn shape that is not the catalogue's, or with the catalogue's own."""
    if candidate.law in UNKNOWN or own_shape:
        return candidate
    return replace(
        candidate, effect=replace(candidate.effect, shape=int(rng.integers(1, SHAPES[candidate.law] + 1)))
    )


def gated(candidate: Candidate, typical: Usual, rng: np.random.Generator) -> Candidate:
    """Return a law at a node in one regime only: over or under a threshold of the potential or the rate."""
    effect = candidate.effect
    assert isinstance(effect, Effect)
    p = float(typical.potential[effect.where])
    if effect.law in _MECHANICAL:
        return replace(candidate, effect=replace(effect, gate=2.0, threshold=float(rng.uniform(0.35, 0.6)) * p))
    middle = effect.zero if effect.law not in ("outflow", "overflow", "leakage") else 0.0
    return replace(
        candidate, effect=replace(effect, gate=1.0, threshold=middle + float(rng.uniform(0.4, 0.65)) * p)
    )


def acting(effects: Sequence[Effect | SignalEffect]) -> tuple[list[Effect], list[SignalEffect]]:
    """Split effects into those of the network and those of signals."""
    return ([e for e in effects if isinstance(e, Effect)], [e for e in effects if isinstance(e, SignalEffect)])


def parts_of(effects: Sequence[SignalEffect]) -> int:
    """Return in how many parts a sample has to be followed."""
    return _PARTS if any(e.law in ("lag", "delay") for e in effects) else 1
