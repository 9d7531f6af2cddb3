"""The grammar of the blind check: rigs of 2 to 8 components in one or two domains. Imports nothing of the tool.

A rig is a network in dimensionless numbers near 1, which is then given units: one power and one time for all
domains, and a usual potential for each. Rigs are light, so that the check of 400 cases ends within three hours on
two cores: runs of 120 to 200 samples, no time constant below a fifth of a sample, and of the rigs with more than
five components one in two.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from benchmarks.blind.plants.network import Controller, DivergedError, Element, Floats, Network, Node

VERSION = 5  # of the grammar; published with every seed
AMBIENT = 293.15
_CP = 4180.0
_TIMES = {"mechanical": (-1.7, 0.0), "electrical": (-4.0, -2.0), "slow": (1.3, 2.6)}
_POTENTIALS = {
    "rotational": (0.5, 2.0), "translational": (-1.7, 0.0), "electrical": (0.3, 2.0), "thermal": (0.8, 1.5),
    "hydraulic": (4.5, 6.0), "tank": (-1.0, 0.3),
}  # fmt: skip
_POWERS = {"mechanical": (0.0, 2.5), "electrical": (0.0, 2.5), "slow": (1.5, 3.5)}
_NODES = {
    "rotational": ("rotor", "wheel", "drum", "flywheel", "spindle", "impeller"),
    "translational": ("carriage", "table", "slider", "cart", "head", "frame"),
    "electrical": ("bus", "filter", "cell", "rail", "terminal"),
    "thermal": ("plate", "core", "case", "wall", "jacket", "ingot"),
    "hydraulic": ("chamber", "volume"),
    "tank": ("upper", "middle", "lower", "basin"),
}
_LINKS = {
    "spring": ("shaft", "coupling", "belt", "rope", "strut", "sleeve"), "mount": ("mount", "suspension"),
    "coil": ("choke", "winding", "line"), "resistor": ("lead", "shunt", "load", "wire"),
    "conductor": ("film", "gap", "pad", "skin", "bridge"), "valve": ("pipe", "orifice", "throat", "outlet"),
}  # fmt: skip


@dataclass(frozen=True)
class Parameter:
    """A parameter of the model: what it sets in the network, and whether as its reciprocal."""

    name: str
    value: float
    unit: str
    words: str
    slot: tuple[str, int, int]  # node or element, its number, number of the parameter
    inverse: bool = False


@dataclass(frozen=True)
class Signal:
    """An input or output: its unit and what it is in words; of an input, its usual range."""

    name: str
    unit: str
    words: str
    low: float = 0.0
    high: float = 0.0


@dataclass(frozen=True)
class Rig:
    """A rig drawn from the grammar.

    Attributes
    ----------
    network
        The plant as its model describes it, with the nominal parameters.
    style
        Whether the model is written with components or as equations.
    dt, samples
        Of a run as it is logged.
    noise
        Standard deviation by output.
    """

    number: int
    network: Network
    parameters: tuple[Parameter, ...]
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    style: str
    dt: float
    samples: int
    noise: tuple[float, ...] = ()
    steps: int = 4  # of the simulation within a sample
    scale: Mapping[str, float] = field(default_factory=dict)  # usual potential by domain
    time: float = 1.0
    thrust: Mapping[str, float] = field(default_factory=dict)  # usual flow by domain

    @property
    def kind(self) -> str:
        """Its domains, in words."""
        return " and ".join(dict.fromkeys(n.domain for n in self.network.nodes))

    @property
    def components(self) -> int:
        """How many stores and branches it has."""
        return len(self.network.nodes) + sum(e.kind != "in" for e in self.network.elements)

    def with_values(self, values: Mapping[str, float]) -> Network:
        """Return the plant with other values of parameters."""
        nodes, elements = list(self.network.nodes), list(self.network.elements)
        for parameter in self.parameters:
            value = values.get(parameter.name, parameter.value)
            value = 1.0 / value if parameter.inverse else value
            what, k, j = parameter.slot
            if what == "node":
                nodes[k] = replace(nodes[k], capacity=value)
            else:
                p = elements[k].p
                elements[k] = replace(elements[k], p=(*p[:j], value, *p[j + 1 :]))
        return replace(self.network, nodes=tuple(nodes), elements=tuple(elements))

    @property
    def nominal(self) -> dict[str, float]:
        """Values of the model's parameters."""
        return {p.name: p.value for p in self.parameters}


def draw_rig(seed: int, number: int) -> Rig:
    """Return rig `number` of a seed; rigs whose plain plant does not move or runs away are drawn again."""
    for attempt in range(100):
        rng = np.random.default_rng([seed, number, attempt, 7])
        try:
            rig = _Drawing(rng).rig(number)
            rig, ranges = _tried(rig, rng)
        except DivergedError:
            continue
        if ranges is None or not 2 <= rig.components <= 8 or (rig.components > 5 and rng.random() < 0.5):
            continue
        share = 10.0 ** rng.uniform(-2.6, -1.9, len(ranges))
        return replace(rig, noise=tuple(float(f"{s * r:.2g}") for s, r in zip(share, ranges, strict=True)))
    raise DivergedError(f"no rig {number} of seed {seed}")


def _tried(rig: Rig, rng: np.random.Generator) -> tuple[Rig, Floats | None]:
    """Return a rig with its steps, and the range of every output in a run.

    None where it hardly moves or leaves what is usual.
    """
    u = np.stack([wave(rng, s, rig.samples, "steps") for s in rig.inputs])
    steps = rig.network.steps(rig.dt, u[:, 0])
    if steps > 20:
        return rig, None
    rig = replace(rig, steps=int(np.ceil(1.25 * steps)))  # its parameters are up to a fifth off
    y, _ = rig.network.run(rig.dt, u, steps)
    ranges = np.ptp(y, axis=1)
    for (what, k), one in zip(rig.network.readings, y, strict=True):
        node = rig.network.nodes[k] if what == "potential" else None
        if node is not None and node.domain == "tank" and one.min() < 0.02 * one.max():
            return rig, None
        if node is not None and np.ptp(one) < 0.1 * rig.scale[node.domain]:
            return rig, None
        if node is not None and np.abs(one - node.start).max() > 8.0 * rig.scale[node.domain]:
            return rig, None
    return rig, ranges if (ranges > 0).all() else None


def wave(rng: np.random.Generator, signal: Signal, samples: int, kind: str, level: float = 1.0) -> Floats:
    """Return an input over a run, of one kind: steps, sines, sweep, stairs, pulses."""
    t = np.arange(samples) / samples
    if kind == "steps":
        pieces = rng.integers(8, 20)
        x = rng.uniform(-1.0, 1.0, pieces)[np.minimum((t * pieces).astype(int), pieces - 1)]
    elif kind == "sines":
        tones = rng.uniform(2.0, 0.06 * samples, 3)
        x = sum(np.sin(2 * np.pi * (f * t + rng.uniform())) for f in tones) / 2.2
    elif kind == "sweep":
        low, high = rng.uniform(1.0, 3.0), rng.uniform(0.06, 0.12) * samples
        x = np.sin(2 * np.pi * (low * t + 0.5 * (high - low) * t**2))
    elif kind == "stairs":
        levels = np.concatenate([np.linspace(-1, 1, 6), np.linspace(1, -1, 6)[1:]])
        x = levels[np.minimum((t * len(levels)).astype(int), len(levels) - 1)]
    else:
        x = np.where(np.sin(2 * np.pi * rng.uniform(2.0, 6.0) * t + rng.uniform(0, 6)) > 0.3, 1.0, -0.6)
    middle, half = 0.5 * (signal.low + signal.high), 0.5 * (signal.high - signal.low)
    return np.asarray([float(f"{v:.5g}") for v in middle + level * half * np.clip(x, -1.0, 1.0)])


KINDS_OF_WAVE = ("steps", "sines", "sweep", "stairs", "pulses")


def controller_of(rig: Rig, rng: np.random.Generator) -> tuple[Controller, Floats] | None:
    """Return a controller of the first input by the first output that is a potential, and a reference.

    None where none suits.
    """
    for k, (what, node) in enumerate(rig.network.readings):
        if what != "potential" or (rig.network.nodes[node].mechanical and len(rig.network.nodes) > 3):
            continue
        domain, signal = rig.network.nodes[node].domain, rig.inputs[0]
        gain = 0.5 * (signal.high - signal.low) / rig.scale[domain]
        middle = 0.5 * (signal.high + signal.low)
        u = np.tile([[0.5 * (s.high + s.low)] for s in rig.inputs], rig.samples)
        y, _ = rig.network.run(rig.dt, u, rig.network.steps(rig.dt, u[:, 0]))
        target = y[k][-rig.samples // 4 :].mean()
        levels = target + 0.6 * rig.scale[domain] * rng.uniform(-1.0, 1.0, 8)
        reference = np.repeat(levels, -(-rig.samples // 8))[: rig.samples]
        low, high = (signal.low, signal.high) if middle else (1.5 * signal.low, 1.5 * signal.high)
        return Controller(
            0, k, float(rng.uniform(0.5, 1.5)) * gain, float(rng.uniform(0.2, 0.6)) * gain / rig.time, low, high
        ), reference
    return None


class _Drawing:
    """One rig while it is drawn."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.nodes: list[Node] = []
        self.elements: list[Element] = []
        self.parameters: list[Parameter] = []
        self.inputs: list[Signal] = []
        self.taken: dict[str, int] = {}

    # Numbers near 1, and names

    def near(self, low: float = -0.4, high: float = 0.4) -> float:
        return float(10.0 ** self.rng.uniform(low, high))

    def chance(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def called(self, pool: str) -> str:
        names = [n for n in (_NODES.get(pool) or _LINKS.get(pool) or (pool,)) if n not in self.taken]
        if names:
            name = names[int(self.rng.integers(len(names)))]
        else:
            base = (_NODES.get(pool) or _LINKS.get(pool) or (pool,))[0]
            name = next(f"{base}{k}" for k in range(2, 99) if f"{base}{k}" not in self.taken)
        self.taken[name] = 1
        return name

    # Units

    def measure(self, family: str, domains: Sequence[str]) -> None:
        self.T = float(10.0 ** self.rng.uniform(*_TIMES[family]))
        power = float(10.0 ** self.rng.uniform(*_POWERS[family]))
        self.P = {d: float(10.0 ** self.rng.uniform(*_POTENTIALS[d])) for d in domains}
        self.F = {d: power if d == "thermal" else power / self.P[d] for d in domains}
        if "tank" in domains:
            self.F["tank"] = float(10.0 ** self.rng.uniform(-5.0, -3.0))

    def keep(
        self, name: str, value: float, unit: str, words: str, slot: tuple[str, int, int], inverse: bool = False
    ) -> float:
        """Note a parameter, rounded as people do; return its value in the network."""
        rounded = float(f"{value:.2g}")
        self.parameters.append(Parameter(name, rounded, unit, words, slot, inverse))
        return 1.0 / rounded if inverse else rounded

    def first(self, name: str, value: float, unit: str, words: str) -> float:
        """Note the first parameter of the element that is added next."""
        return self.keep(name, value, unit, words, ("element", len(self.elements), 0))

    # Parts

    def store(self, domain: str, size: float | None = None) -> int:
        name, k = self.called(domain), len(self.nodes)
        letter, unit, words = {
            "rotational": ("J", "kg.m2", "Inertia"), "translational": ("m", "kg", "Mass"),
            "electrical": ("C", "F", "Capacitance"), "thermal": ("C", "J/K", "Heat capacity"),
            "hydraulic": ("C", "m3/Pa", "Capacity"), "tank": ("A", "m2", "Section"),
        }[domain]  # fmt: skip
        value = (size or self.near()) * self.F[domain] * self.T / self.P[domain]
        capacity = self.keep(f"{name}.{letter}", value, unit, words, ("node", k, 0))
        start = (
            AMBIENT if domain == "thermal" else float(f"{0.8 * self.P[domain]:.2g}") if domain == "tank" else 0.0
        )
        self.nodes.append(Node(name, domain, capacity, start))
        return k

    def add(self, element: Element) -> int:
        self.elements.append(element)
        return len(self.elements) - 1

    def driven(self, domain: str) -> int:
        """Add a node whose potential is an input: a voltage."""
        self.inputs.append(Signal("u", "V", "Supply voltage", -self.P[domain], self.P[domain]))
        self.nodes.append(Node("supply", domain, driven=len(self.inputs) - 1))
        self.taken["supply"] = 1
        return len(self.nodes) - 1

    def pushed(self, node: int) -> None:
        """Add an input that flows into a node."""
        domain = self.nodes[node].domain
        f, two_sided = self.F[domain], domain in ("rotational", "translational", "electrical", "hydraulic")
        name, unit, words = {
            "rotational": ("tau", "N.m", "Drive torque"), "translational": ("f", "N", "Drive force"),
            "electrical": ("i_in", "A", "Supply current"), "thermal": ("P_heat", "W", "Heater power"),
            "hydraulic": ("q_in", "m3/s", "Pump flow"), "tank": ("q_in", "m3/s", "Pump flow"),
        }[domain]  # fmt: skip
        high = float(f"{f * self.near(-0.1, 0.2):.2g}")
        low = -high if two_sided else 0.0 if domain == "thermal" else 0.4 * high
        self.inputs.append(Signal(name, unit, words, low, high))
        self.add(Element("in", name, node, u=len(self.inputs) - 1, p=(1.0,)))

    def damper(self, node: int, size: float | None = None) -> None:
        d = self.nodes[node].domain
        unit = "N.m.s/rad" if d == "rotational" else "N.s/m"
        name = self.called(f"{self.nodes[node].name}_bearing")
        g = self.first(
            f"{name}.d", (size or self.near(-0.7, 0.0)) * self.F[d] / self.P[d], unit, "Viscous friction"
        )
        self.add(Element("cond", name, node, p=(g, 0.0)))

    def spring(self, a: int, b: int) -> None:
        d = self.nodes[a].domain
        stiff = self.near(0.7, 1.3) if b >= 0 else self.near(0.0, 0.8)
        c, loss = (
            stiff * self.F[d] / (self.P[d] * self.T),
            2 * self.near(-1.2, -0.6) * np.sqrt(stiff) * self.F[d] / self.P[d],
        )
        units = ("N.m/rad", "N.m.s/rad") if d == "rotational" else ("N/m", "N.s/m")
        name, k = self.called("spring" if b >= 0 else "mount"), len(self.elements)
        p = (
            self.keep(f"{name}.c", c, units[0], "Stiffness", ("element", k, 0)),
            self.keep(f"{name}.d", float(loss), units[1], "Damping", ("element", k, 1)),
        )
        self.add(Element("spring", name, a, b, p=p))

    def chain(self, domain: str, count: int, first: int | None = None) -> list[int]:
        """Add bodies one behind the other, with friction and springs."""
        bodies = [] if first is None else [first]
        while len(bodies) < count:
            bodies.append(self.store(domain))
        for a, b in pairwise(bodies):
            self.spring(a, b)
        rubbed = [b for b in bodies if self.chance(0.5)] or [bodies[-1]]
        for body in rubbed:
            self.damper(body)
        if domain == "translational" and self.chance(0.4):
            self.spring(bodies[-1], -1)
        if self.chance(0.3):
            body = bodies[int(self.rng.integers(len(bodies)))]
            name = self.called(f"{self.nodes[body].name}_seal")
            unit = "N.m" if domain == "rotational" else "N"
            f = self.first(f"{name}.F", 0.15 * self.near() * self.F[domain], unit, "Dry friction")
            self.add(Element("dry", name, body, p=(f, float(f"{0.02 * self.P[domain]:.1g}"))))
        elif self.chance(0.2):
            body = bodies[-1]
            name = self.called(f"{self.nodes[body].name}_drag")
            unit = "N.m.s2/rad2" if domain == "rotational" else "N.s2/m2"
            f = self.first(f"{name}.K", 0.3 * self.near() * self.F[domain] / self.P[domain] ** 2, unit, "Drag")
            self.add(Element("drag", name, body, p=(f,)))
        return bodies

    def resistor(self, a: int, b: int, size: float | None = None) -> None:
        name, k = self.called("resistor"), len(self.elements)
        r = (size or self.near()) * self.P["electrical"] / self.F["electrical"]
        g = self.keep(f"{name}.R", r, "Ohm", "Resistance", ("element", k, 0), inverse=True)
        self.add(Element("cond", name, a, b, p=(g, 0.0)))

    def coil(self, a: int, b: int) -> None:
        name, k = self.called("coil"), len(self.elements)
        z = self.P["electrical"] / self.F["electrical"]
        p = (
            self.keep(f"{name}.L", self.near(-0.9, -0.1) * z * self.T, "H", "Inductance", ("element", k, 0)),
            self.keep(f"{name}.R", self.near(-0.7, 0.0) * z, "Ohm", "Resistance", ("element", k, 1)),
        )
        self.add(Element("coil", name, a, b, p=p))

    def ladder(self, count: int) -> list[int]:
        """Add an electrical network behind a voltage."""
        begin = self.driven("electrical")
        nodes = [begin]
        for _ in range(count):
            nodes.append(self.store("electrical"))
            (self.coil if self.chance(0.6) else self.resistor)(nodes[-2], nodes[-1])
        if not any(e.kind == "coil" for e in self.elements) or self.chance(0.7):
            self.resistor(nodes[-1], -1)
        return nodes[1:]

    def warm(self, count: int) -> list[int]:
        """Add heat stores as a tree; at least one loses heat to the surroundings."""
        stores = [self.store("thermal")]
        while len(stores) < count:
            stores.append(self.store("thermal"))
            self.conductor(stores[int(self.rng.integers(len(stores) - 1))], stores[-1])
        losing = [s for s in stores if self.chance(0.3)] or [stores[-1]]
        for store in losing:
            self.conductor(store, -1)
        return stores

    def conductor(self, a: int, b: int) -> None:
        name = self.called("conductor" if b >= 0 else f"{self.nodes[a].name}_loss")
        g = self.first(f"{name}.G", self.near() * self.F["thermal"] / self.P["thermal"], "W/K", "Conductance")
        self.add(Element("cond", name, a, b, p=(g, AMBIENT if b < 0 else 0.0)))

    def tanks(self, count: int) -> list[int]:
        """Add tanks that drain one into another."""
        tanks = [self.store("tank") for _ in range(count)]
        for a, b in zip(tanks, [*tanks[1:], -1], strict=True):
            name = self.called("valve")
            p0, f0 = self.P["tank"], self.F["tank"]
            size = self.first(
                f"{name}.K", self.near(-0.15, 0.15) * f0 / np.sqrt(p0), "m2.5/s", "Flow by root of the level"
            )
            self.add(Element("valve", name, a, b, p=(size, float(f"{0.03 * p0:.1g}"))))
        return tanks

    # Whole rigs

    def rig(self, number: int) -> Rig:
        kinds = (
            "rotational", "translational", "electrical", "thermal", "tank", "motor", "rack", "heater", "cylinder",
            "stream",
        )  # fmt: skip
        kind = kinds[(number + int(self.rng.integers(2))) % len(kinds)]
        getattr(self, f"_{kind}")()
        style = ("components", "equations")[number // len(kinds) % 2]
        samples = int(self.rng.integers(120, 200))
        dt = float(f"{self.T * self.rng.uniform(0.09, 0.15):.2g}")
        network = Network(tuple(self.nodes), tuple(self.elements), (), len(self.inputs))
        readings, outputs = self.sensors()
        network = replace(network, readings=readings)
        parameters, network = self.renamed(style, network)
        return Rig(
            number, network, parameters, tuple(self.inputs), outputs, style, dt, samples,
            scale=self.P, time=self.T, thrust=self.F,
        )  # fmt: skip

    def renamed(self, style: str, network: Network) -> tuple[tuple[Parameter, ...], Network]:
        """Return parameters with flat names where the model is written as equations."""
        if style == "components":
            return tuple(self.parameters), network
        return tuple(replace(p, name="_".join(reversed(p.name.split(".")))) for p in self.parameters), network

    def _rotational(self) -> None:
        self.measure("mechanical", ["rotational"])
        self.pushed(self.chain("rotational", int(self.rng.integers(1, 4)))[0])

    def _translational(self) -> None:
        self.measure("mechanical", ["translational"])
        self.pushed(self.chain("translational", int(self.rng.integers(1, 4)))[0])

    def _electrical(self) -> None:
        self.measure("electrical", ["electrical"])
        self.ladder(int(self.rng.integers(1, 4)))

    def _thermal(self) -> None:
        self.measure("slow", ["thermal"])
        self.pushed(self.warm(int(self.rng.integers(1, 5)))[0])

    def _tank(self) -> None:
        self.measure("slow", ["tank"])
        self.pushed(self.tanks(int(self.rng.integers(1, 4)))[0])

    def _motor(self) -> None:
        self.measure("mechanical", ["electrical", "rotational"])
        begin = self.driven("electrical")
        name, k = self.called("motor"), len(self.elements)
        z = self.P["electrical"] / self.F["electrical"]
        constant = self.near(-0.2, 0.2) * self.F["rotational"] / self.F["electrical"]
        p = (
            self.keep(f"{name}.L", self.near(-1.0, -0.4) * z * self.T, "H", "Inductance", ("element", k, 0)),
            self.keep(f"{name}.R", self.near(-0.5, 0.0) * z, "Ohm", "Resistance", ("element", k, 1)),
            self.keep(f"{name}.k", constant, "N.m/A", "Torque constant", ("element", k, 2)),
        )  # fmt: skip
        shaft = self.store("rotational")
        self.elements.append(Element("motor", name, begin, shaft, p=p))
        self.chain("rotational", int(self.rng.integers(1, 4)), first=shaft)

    def _rack(self) -> None:
        self.measure("mechanical", ["rotational", "translational"])
        first = self.chain("rotational", int(self.rng.integers(1, 3)))
        self.pushed(first[0])
        body = self.store("translational")
        name, k = self.called("rack"), len(self.elements)
        r0, stiff = self.P["translational"] / self.P["rotational"], self.near(0.7, 1.3)
        unit = self.F["translational"] / self.P["translational"]
        loss = 2 * self.near(-1.2, -0.6) * float(np.sqrt(stiff)) * unit
        p = (
            self.keep(f"{name}.r", self.near(-0.2, 0.2) * r0, "m", "Radius of the pinion", ("element", k, 0)),
            self.keep(f"{name}.c", stiff * unit / self.T, "N/m", "Stiffness", ("element", k, 1)),
            self.keep(f"{name}.d", loss, "N.s/m", "Damping", ("element", k, 2)),
        )  # fmt: skip
        self.elements.append(Element("gear", name, first[-1], body, p=p))
        self.chain("translational", 1, first=body)

    def _heater(self) -> None:
        self.measure("slow", ["electrical", "thermal"])
        self.inputs.append(Signal("u", "V", "Heater voltage", 0.0, 1.5 * self.P["electrical"]))
        self.nodes.append(Node("supply", "electrical", driven=0))
        stores = self.warm(int(self.rng.integers(1, 4)))
        name = self.called("heater")
        r = self.first(
            f"{name}.R", self.near(-0.2, 0.2) * self.P["electrical"] / self.F["electrical"], "Ohm", "Resistance"
        )
        self.elements.append(Element("heater", name, 0, c=stores[0], p=(r,)))

    def _cylinder(self) -> None:
        self.measure("mechanical", ["hydraulic", "translational"])
        chamber = self.store("hydraulic")
        self.pushed(chamber)
        name = self.called(f"{self.nodes[chamber].name}_leak")
        g = self.first(
            f"{name}.G", self.near(-0.4, 0.0) * self.F["hydraulic"] / self.P["hydraulic"], "m3/(s.Pa)", "Leakage"
        )
        self.add(Element("cond", name, chamber, p=(g, 0.0)))
        body = self.store("translational")
        name = self.called("piston")
        area = self.first(
            f"{name}.A", self.near(-0.2, 0.2) * self.F["translational"] / self.P["hydraulic"], "m2", "Area"
        )
        self.elements.append(Element("piston", name, chamber, body, p=(area,)))
        self.chain("translational", int(self.rng.integers(1, 3)), first=body)

    def _stream(self) -> None:
        self.measure("slow", ["thermal"])
        stores = self.warm(int(self.rng.integers(1, 4)))
        self.pushed(stores[0])
        flow = float(f"{self.near(-0.2, 0.2) * self.F['thermal'] / self.P['thermal'] / _CP:.2g}")
        self.inputs.append(Signal("m_flow", "kg/s", "Mass flow of the water", 0.2 * flow, flow))
        self.add(Element("stream", "feed", stores[-1], u=1, p=(_CP, AMBIENT)))

    def sensors(self) -> tuple[tuple[tuple[str, int], ...], tuple[Signal, ...]]:
        """Choose what is measured: the first and the last store of every domain, and some in between."""
        units = {
            "rotational": ("w", "rad/s", "Speed"), "translational": ("v", "m/s", "Speed"),
            "electrical": ("v", "V", "Voltage"), "thermal": ("T", "K", "Temperature"),
            "hydraulic": ("p", "Pa", "Pressure"), "tank": ("h", "m", "Level"),
        }  # fmt: skip
        readings, outputs = [], []
        free = [k for k, n in enumerate(self.nodes) if n.driven < 0]
        for k in free:
            node = self.nodes[k]
            end = k in (free[0], free[-1])
            if (not end and self.chance(0.5)) or (k == free[0] and len(free) > 2 and self.chance(0.25)):
                continue
            letter, unit, words = units[node.domain]
            what = "potential"
            if node.mechanical and self.chance(0.5):
                what, letter, unit, words = (
                    ("position", "phi", "rad", "Angle")
                    if node.domain == "rotational"
                    else ("position", "s", "m", "Position")
                )
            readings.append((what, k))
            outputs.append(Signal(f"{letter}_{node.name}", unit, f"{words} of the {node.name}"))
        for k, element in enumerate(self.elements):
            if element.kind == "motor" or (element.kind == "coil" and self.chance(0.5)):
                readings.append(("state", k))
                outputs.append(Signal(f"i_{element.name}", "A", f"Current of the {element.name}"))
        return tuple(readings), tuple(outputs)
