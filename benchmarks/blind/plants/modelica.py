"""The plain Modelica model of a rig: with components like the Standard Library's, or as equations."""

from __future__ import annotations

from itertools import pairwise

from benchmarks.blind.plants.grammar import Rig
from benchmarks.blind.plants.network import Element

# By domain: connector, its potential and flow with their units, store, potential of the store with its unit.
_DOMAINS = {
    "rotational": ("Flange", "phi", "rad", "tau", "N.m", "Inertia", "w", "rad/s"),
    "translational": ("Slide", "s", "m", "f", "N", "Mass", "v", "m/s"),
    "electrical": ("Pin", "v", "V", "i", "A", "Capacitor", "v", "V"),
    "thermal": ("HeatPort", "T", "K", "Q_flow", "W", "HeatCapacitor", "T", "K"),
    "hydraulic": ("FluidPort", "p", "Pa", "q", "m3/s", "Chamber", "p", "Pa"),
    "tank": ("Opening", "h", "m", "q", "m3/s", "Tank", "h", "m"),
}


def class_name(rig: Rig) -> str:
    """Return the model's name."""
    return f"Rig{rig.number:03d}"


def modelica(rig: Rig) -> str:
    """Return the model's source."""
    return _with_components(rig) if rig.style == "components" else _as_equations(rig)


def place_of(rig: Rig, what: str, k: int) -> str:
    """Return the name by which a diagnosis knows a node or element of the rig."""
    if rig.style == "components":
        return rig.network.nodes[k].name if what == "node" else rig.network.elements[k].name
    if what == "node":
        return f"{_state(rig, k)}.balance"
    element = rig.network.elements[k]
    if element.kind in ("coil", "motor"):
        return f"i_{element.name}.balance"
    return ".".join(sorted(_state(rig, n) for n in (element.a, element.b)))


def _signals(rig: Rig) -> list[str]:
    return [f'  input Real {s.name}(unit="{s.unit}") "{s.words}";' for s in rig.inputs] + [
        f'  output Real {s.name}(unit="{s.unit}") "{s.words}";' for s in rig.outputs
    ]


def _number(value: float) -> str:
    return f"{value:.12g}"


# With components ------------------------------------------------------------------------------------------------


def _with_components(rig: Rig) -> str:
    network, models = rig.network, {}
    declared, connected, ports = [], [], {k: [] for k in range(len(network.nodes))}
    values: dict[str, list[str]] = {}
    for p in rig.parameters:
        owner, _, name = p.name.partition(".")
        values.setdefault(owner, []).append(f"{name}={_number(p.value)}")

    def instance(model: str, name: str) -> None:
        given = ", ".join(values.get(name, []))
        declared.append(f"  {model} {name}{f'({given})' if given else ''};")

    domains = dict.fromkeys(n.domain for n in network.nodes)
    connectors = [_connector(d) for d in domains]
    for k, node in enumerate(network.nodes):
        domain = _DOMAINS[node.domain]
        if node.driven >= 0:
            models["SignalVoltage"] = _SOURCE_VOLTAGE
            instance("SignalVoltage", node.name)
            connected.append(f"  {node.name}.u = {rig.inputs[node.driven].name};")
        else:
            models[domain[5]] = _store(node.domain, node.start)
            instance(domain[5], node.name)
        ports[k].append(f"{node.name}.port")
    for element in network.elements:
        model, text, ends, wired = _component(rig, element)
        models[model] = text
        instance(model, _instance_name(element))
        connected += wired
        for node, port in ends:
            ports[node].append(f"{_instance_name(element)}.{port}")
    for joined in ports.values():
        connected += [f"  connect({a}, {b});" for a, b in pairwise(joined)]
    read = []
    for (what, k), signal in zip(network.readings, rig.outputs, strict=True):
        if what == "state":
            read.append(f"  {signal.name} = {network.elements[k].name}.i;")
        else:
            domain = _DOMAINS[network.nodes[k].domain]
            read.append(
                f"  {signal.name} = {network.nodes[k].name}.{domain[1] if what == 'position' else domain[6]};"
            )
    name = class_name(rig)
    parts = [f'model {name} "{rig.kind}"', *connectors, *models.values(), *_signals(rig), *declared, "equation"]
    return "\n".join([*parts, *connected, *read, f"end {name};"]) + "\n"


def _instance_name(element: Element) -> str:
    return f"source_{element.name}" if element.kind == "in" else element.name


def _connector(domain: str) -> str:
    name, potential, p_unit, flow, f_unit, *_ = _DOMAINS[domain]
    lines = [
        f"  connector {name}",
        f'    Real {potential}(unit="{p_unit}");',
        f'    flow Real {flow}(unit="{f_unit}");',
    ]
    return "\n".join([*lines, f"  end {name};"])


_SOURCE_VOLTAGE = """\
  model SignalVoltage
    Pin port;
    input Real u(unit="V");
  equation
    port.v = u;
  end SignalVoltage;"""


def _store(domain: str, start: float) -> str:
    connector, potential, p_unit, flow, _, model, rate, r_unit = _DOMAINS[domain]
    letter, unit = {
        "Inertia": ("J", "kg.m2"), "Mass": ("m", "kg"), "Capacitor": ("C", "F"), "HeatCapacitor": ("C", "J/K"),
        "Chamber": ("C", "m3/Pa"), "Tank": ("A", "m2"),
    }[model]  # fmt: skip
    head = f'  model {model}\n    {connector} port;\n    parameter Real {letter}(unit="{unit}", min=0) = 1;\n'
    if potential != rate:
        return head + (
            f'    Real {potential}(unit="{p_unit}", start=0, fixed=true);\n'
            f'    Real {rate}(unit="{r_unit}", start=0, fixed=true);\n'
            f"  equation\n    {potential} = port.{potential};\n    {rate} = der({potential});\n"
            f"    {letter}*der({rate}) = port.{flow};\n  end {model};"
        )
    return head + (
        f'    Real {rate}(unit="{r_unit}", start={_number(start)}, fixed=true);\n'
        f"  equation\n    {rate} = port.{potential};\n    {letter}*der({rate}) = port.{flow};\n  end {model};"
    )


def _component(rig: Rig, e: Element) -> tuple[str, str, list[tuple[int, str]], list[str]]:
    """Return a component's model, its text, which node each connector is at, and the equations around it."""
    nodes = rig.network.nodes
    domain = nodes[e.a if e.a >= 0 else e.b].domain
    connector, pot, p_unit, flow, f_unit, *_, r_unit = _DOMAINS[domain]
    two = e.b >= 0
    ends = [(e.a, "a"), (e.b, "b")] if two else [(e.a, "a")]
    both = f"    {connector} a, b;" if two else f"    {connector} a;"
    back = f"\n    b.{flow} = -a.{flow};" if two else ""
    across = f"a.{pot} - b.{pot}" if two else f"a.{pot}"
    real = '    parameter Real {0}(unit="{1}", min=0) = 1;'

    def model(name: str, declared: list[str], equations: list[str]) -> str:
        return "\n".join(
            [f"  model {name}", *declared, "  equation", *(f"    {q}" for q in equations), f"  end {name};"]
        )

    if e.kind == "in":
        signal = rig.inputs[e.u]
        name = f"Source{connector}"
        text = model(
            name, [f"    {connector} a;", f'    input Real u(unit="{signal.unit}");'], [f"a.{flow} = -u;"]
        )
        return name, text, ends, [f"  {_instance_name(e)}.u = {signal.name};"]
    if e.kind == "cond" and nodes[e.a].mechanical:
        d_unit = "N.m.s/rad" if domain == "rotational" else "N.s/m"
        name = f"{'Rotational' if domain == 'rotational' else 'Sliding'}Bearing"
        return name, model(name, [both, real.format("d", d_unit)], [f"a.{flow} = d*der(a.{pot});"]), ends, []
    if e.kind == "cond":
        if domain == "electrical":
            name, law = ("Resistor" if two else "GroundedResistor"), f"R*a.{flow} = {across};"
            return name, model(name, [both, real.format("R", "Ohm")], [law + back]), ends, []
        g_unit = "W/K" if domain == "thermal" else "m3/(s.Pa)"
        name = "Conductor" if two else "Loss" if domain == "thermal" else "Leak"
        ambient = f" - {_number(e.p[1])}" if e.p[1] and not two else ""
        return (
            name,
            model(name, [both, real.format("G", g_unit)], [f"a.{flow} = G*({across}{ambient});{back}"]),
            ends,
            [],
        )
    if e.kind == "spring":
        c, d = ("N.m/rad", "N.m.s/rad") if domain == "rotational" else ("N/m", "N.s/m")
        name = ("SpringDamper" if two else "Mount") + ("" if domain == "rotational" else "Linear")
        declared = [both, real.format("c", c), real.format("d", d), f'    Real rel(unit="{p_unit}");']
        return name, model(name, declared, [f"rel = {across};", f"a.{flow} = c*rel + d*der(rel);{back}"]), ends, []
    if e.kind == "coil":
        declared = [
            both,
            real.format("L", "H"),
            real.format("R", "Ohm"),
            '    Real i(unit="A", start=0, fixed=true);',
        ]
        return "Inductor", model("Inductor", declared, ["i = a.i;", f"L*der(i) = {across} - R*i;{back}"]), ends, []
    if e.kind == "valve":
        name = "Pipe" if two else "Outlet"
        eps = _number(e.p[1])
        law = f"a.q = K*({across})/(({across})^2 + {eps}^2)^0.25;{back}"
        return name, model(name, [both, real.format("K", "m2.5/s")], [law]), ends, []
    if e.kind == "motor":
        declared = [
            "    Pin a;\n    Flange b;", real.format("L", "H"),
            real.format("R", "Ohm"), real.format("k", "N.m/A"),
            '    Real i(unit="A", start=0, fixed=true);',
        ]  # fmt: skip
        text = model("DCMotor", declared, ["i = a.i;", "L*der(i) = a.v - R*i - k*der(b.phi);", "b.tau = -k*i;"])
        return "DCMotor", text, ends, []
    if e.kind == "gear":
        declared = [
            "    Flange a;\n    Slide b;", real.format("r", "m"),
            real.format("c", "N/m"), real.format("d", "N.s/m"),
            '    Real rel(unit="m");',
        ]  # fmt: skip
        laws = ["rel = r*a.phi - b.s;", "b.f = -(c*rel + d*der(rel));", "a.tau = -r*b.f;"]
        return "ElasticRack", model("ElasticRack", declared, laws), ends, []
    if e.kind == "piston":
        declared = ["    FluidPort a;", "    Slide b;", real.format("A", "m2")]
        return "Piston", model("Piston", declared, ["a.q = A*der(b.s);", "b.f = -A*a.p;"]), ends, []
    if e.kind == "heater":
        declared = ["    Pin a;", "    HeatPort c;", real.format("R", "Ohm")]
        text = model("HeatingResistor", declared, ["R*a.i = a.v;", "c.Q_flow = -a.v*a.i;"])
        return "HeatingResistor", text, [(e.a, "a"), (e.c, "c")], []
    if e.kind == "stream":
        declared = [
            "    HeatPort a;",
            '    constant Real cp(unit="J/(kg.K)") = 4180;',
            '    input Real m_flow(unit="kg/s");',
        ]
        text = model("Stream", declared, [f"a.Q_flow = m_flow*cp*(a.T - {_number(e.p[1])});"])
        return "Stream", text, ends, [f"  {e.name}.m_flow = {rig.inputs[e.u].name};"]
    if e.kind == "drag":
        k_unit, name = ("N.m.s2/rad2", "Fan") if domain == "rotational" else ("N.s2/m2", "Drag")
        law = f"a.{flow} = K*der(a.{pot})*abs(der(a.{pot}));"
        return name, model(name, [both, real.format("K", k_unit)], [law]), ends, []
    name = "RotatingSeal" if domain == "rotational" else "SlidingSeal"
    soft = f'    constant Real v_soft(unit="{r_unit}") = {_number(e.p[1])};'
    declared = [both, real.format("F", f_unit), soft, f'    Real v(unit="{r_unit}");']
    return name, model(name, declared, [f"v = der(a.{pot});", f"a.{flow} = F*tanh(v/v_soft);"]), ends, []


# As equations ---------------------------------------------------------------------------------------------------


def _state(rig: Rig, k: int) -> str:
    node = rig.network.nodes[k]
    return f"{_DOMAINS[node.domain][6]}_{node.name}"


def _position(rig: Rig, k: int) -> str:
    node = rig.network.nodes[k]
    return f"{_DOMAINS[node.domain][1]}_{node.name}"


def _as_equations(rig: Rig) -> str:
    network = rig.network
    nodes = network.nodes
    taken = {s.name for s in rig.outputs}

    def potential(k: int) -> str:
        if k < 0:
            return "0"
        return rig.inputs[nodes[k].driven].name if nodes[k].driven >= 0 else named(_state(rig, k))

    def named(variable: str) -> str:  # an output of that name is the state itself
        return variable

    named_parameters = {p.slot: p.name for p in rig.parameters}
    declared = [
        f'  parameter Real {p.name}(unit="{p.unit}", min=0) = {_number(p.value)} "{p.words}";'
        for p in rig.parameters
    ]
    begun, equations = _constants(rig), []
    balance: dict[int, list[str]] = {k: [] for k in range(len(nodes))}
    for k, node in enumerate(nodes):
        if node.driven >= 0:
            continue
        unit = _DOMAINS[node.domain][7]
        state = _state(rig, k)
        start = f"start={_number(node.start)}, fixed=true"
        declared_as = [(state, unit, start)]
        if node.mechanical:
            declared_as.append((_position(rig, k), _DOMAINS[node.domain][2], "start=0, fixed=true"))
            equations.append(f"  der({_position(rig, k)}) = {state};")
        begun += [f'  Real {n}(unit="{u}", {s});' for n, u, s in declared_as if n not in taken]
    for k, e in enumerate(network.elements):
        at = {j: named_parameters.get(("element", k, j), "") for j in range(4)}
        pa, pb = potential(e.a), potential(e.b)
        across = f"({pa} - {pb})" if e.b >= 0 else pa
        if e.kind == "in":
            balance[e.a].append(f"+ {rig.inputs[e.u].name}")
            continue
        if e.kind in ("coil", "motor"):
            i = f"i_{e.name}"
            if i not in taken:
                begun.append(f'  Real {i}(unit="A", start=0, fixed=true);')
            emf = f" - {at[2]}*{pb}" if e.kind == "motor" else f" - {pb}" if e.b >= 0 else ""
            equations.append(f"  {at[0]}*der({i}) = {pa} - {at[1]}*{i}{emf};")
            flows = [(e.a, f"- {i}"), (e.b, f"+ {at[2]}*{i}" if e.kind == "motor" else f"+ {i}")]
        elif e.kind == "gear":
            twist = f"({at[0]}*{_position(rig, e.a)} - {_position(rig, e.b)})"
            f = f"({at[1]}*{twist} + {at[2]}*({at[0]}*{pa} - {pb}))"
            flows = [(e.a, f"- {at[0]}*{f}"), (e.b, f"+ {f}")]
        elif e.kind == "piston":
            flows = [(e.a, f"- {at[0]}*{pb}"), (e.b, f"+ {at[0]}*{pa}")]
        elif e.kind == "heater":
            flows = [(e.c, f"+ {pa}^2/{at[0]}")]
        else:
            flow = _flow(rig, e, at, across, pa)
            flows = [(e.a, f"- {flow}"), (e.b, f"+ {flow}")]
        for node, term in flows:
            if node >= 0:
                balance[node].append(term)
    for k, node in enumerate(nodes):
        if node.driven < 0:
            terms = " ".join(balance[k]).removeprefix("+ ")
            equations.append(f"  {named_parameters['node', k, 0]}*der({_state(rig, k)}) = {terms};")
    signals = []
    for s in rig.inputs:
        signals.append(f'  input Real {s.name}(unit="{s.unit}") "{s.words}";')
    starts = {_state(rig, k): n.start for k, n in enumerate(nodes)}
    for s in rig.outputs:  # every output is a state
        signals.append(
            f'  output Real {s.name}(unit="{s.unit}", start={_number(starts.get(s.name, 0.0))}, fixed=true)'
            f' "{s.words}";'
        )
    name = class_name(rig)
    return (
        "\n".join(
            [f'model {name} "{rig.kind}"', *signals, *declared, *begun, "equation", *equations, f"end {name};"]
        )
        + "\n"
    )


def _flow(rig: Rig, e: Element, at: dict[int, str], across: str, pa: str) -> str:
    """Return the flow of a branch from its first node to its second."""
    if e.kind == "cond":
        inverse = next(p.inverse for p in rig.parameters if p.name == at[0])
        if inverse:
            return f"{across}/{at[0]}"
        return f"{at[0]}*({pa} - {_number(e.p[1])})" if e.b < 0 and e.p[1] else f"{at[0]}*{across}"
    if e.kind == "spring":
        twist = f"({_position(rig, e.a)} - {_position(rig, e.b)})" if e.b >= 0 else _position(rig, e.a)
        return f"({at[0]}*{twist} + {at[1]}*{across})"
    if e.kind == "valve":
        return f"{at[0]}*{across}/({across}^2 + {_number(e.p[1])}^2)^0.25"
    if e.kind == "stream":
        return f"cp*{rig.inputs[e.u].name}*({pa} - {_number(e.p[1])})"
    if e.kind == "drag":
        return f"{at[0]}*{pa}*abs({pa})"
    return f"{at[0]}*tanh({pa}/{e.name}_v)"


def _constants(rig: Rig) -> list[str]:
    lines = []
    for e in rig.network.elements:
        if e.kind == "stream":
            lines.append(f'  constant Real cp(unit="J/(kg.K)") = {_number(e.p[0])};')
        elif e.kind == "dry":
            unit = _DOMAINS[rig.network.nodes[e.a].domain][7]
            lines.append(f'  constant Real {e.name}_v(unit="{unit}") = {_number(e.p[1])};')
    return lines
