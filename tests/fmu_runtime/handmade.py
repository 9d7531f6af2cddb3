"""Compiled models written down by hand with CasADi: the C runtime's tests need no Modelica compiler."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence

import casadi as ca

from fmu_build.codegen import Header, Slopes, c_files
from fmu_build.model import CompiledModel, Experiment, Location, Unit, Variable


def with_diagonal(matrix: ca.SX, n: int) -> ca.SX:
    """The first n entries of the diagonal stored, zero or not."""
    pattern = matrix.sparsity() + ca.Sparsity.triplet(*matrix.shape, list(range(n)), list(range(n)))
    return ca.project(matrix, pattern)


ENV = ["t", "x", "u", "p", "d", "z", "pz", "m", "y"]


def compile_by_hand(
    name: str,
    *,
    states: Mapping[str, float | Callable],
    rhs: Callable,  # environment -> list of derivatives
    inputs: Mapping[str, float] | None = None,
    parameters: Mapping[str, float] | None = None,
    dependent: Mapping[str, Callable] | None = None,  # p -> value
    outputs: Mapping[str, Callable] | None = None,  # environment -> value
    discrete: Mapping[str, float] | None = None,
    relations: Callable | None = None,  # environment -> list of indicators
    update: Callable | None = None,  # environment, init -> dict(z=, x=, next=, terminate=, reinit=)
    loops: Mapping[str, float] | None = None,
    loop: Callable | None = None,
    asserts: Sequence[tuple[Callable, str, bool]] = (),
    nominal: Mapping[str, float] | None = None,
    tunable: Sequence[str] = (),
) -> CompiledModel:
    inputs, parameters, dependent = dict(inputs or {}), dict(parameters or {}), dict(dependent or {})
    outputs, discrete, loops = dict(outputs or {}), dict(discrete or {}), dict(loops or {})
    nx, nu, np_, nd = len(states), len(inputs), len(parameters), len(dependent)
    nz, ny, nv = len(discrete), len(loops), len(outputs)

    class Environment:
        def __init__(self, **vectors):
            self.vectors = vectors
            for names, letter in (
                (states, "x"),
                (inputs, "u"),
                (parameters, "p"),
                (dependent, "d"),
                (discrete, "z"),
                (loops, "y"),
            ):
                for i, n in enumerate(names):
                    setattr(self, n, vectors[letter][i])
            for i, n in enumerate(discrete):
                setattr(self, "pre_" + n, vectors["pz"][i])
            self.time, self.relation = vectors["t"], vectors["m"]

    def vec(items):
        return ca.vertcat(*[ca.SX(i) for i in items]) if items else ca.SX(0, 1)

    sizes = {"t": 1, "x": nx, "u": nu, "p": np_, "d": nd, "z": nz, "pz": nz, "y": ny}
    probe = {k: ca.SX.sym(k, n) for k, n in sizes.items()}
    nm = 0
    if relations:
        nm = len(relations(Environment(**probe, m=ca.SX.sym("m", 50))))
    s = {**probe, "m": ca.SX.sym("m", nm)}
    e = Environment(**s)
    env = [s[k] for k in ENV]
    dx = vec(rhs(e))
    d_of_p = vec([f(e) for f in dependent.values()])
    v = vec([f(e) for f in outputs.values()])
    xs = vec([f(e) if callable(f) else f for f in states.values()])
    r = vec(loop(e)) if loop else ca.SX(0, 1)
    x_given = ca.SX.sym("xs", nx)
    init = ca.SX.sym("init")
    up = update(e, init) if update else {}
    p, d = s["p"], s["d"]
    by = {**s, "xs": x_given}
    seed = {k: ca.SX.sym("s_" + k, by[k].numel()) for k in ("x", "u", "p", "d", "y", "xs", "z", "pz", "t")}
    held = ["z", "pz"] if nz else []
    moving = [*"xupdy", "z", "pz", "t"]

    def along(f, letters):
        slopes = (ca.jacobian(f, by[k]) @ seed[k] for k in letters if f.numel() and by[k].numel())
        return sum(slopes, ca.SX.zeros(f.numel(), 1))

    def seeds(letters):
        return [seed[k] for k in letters]

    both = ca.vertcat(s["x"], s["y"])
    initial = ca.vertcat(s["x"] - x_given, r)
    g = vec(relations(e)) if relations else ca.SX(0, 1)
    system = ca.vertcat(dx, r)

    def by_parameters(f, *first):
        both_z = ca.jacobian(f, s["z"]) + ca.jacobian(f, s["pz"]) if nz else ca.SX(f.numel(), 0)
        return ca.horzcat(ca.jacobian(f, ca.vertcat(*first, p, d)), both_z)

    def places(matrix):
        return list(zip(*matrix.sparsity().get_triplet(), matrix.nonzeros(), strict=True))

    by_parameter, shown = by_parameters(system), by_parameters(v, both)
    updated = [
        vec([up.get("z", {}).get(n, s["z"][i]) for i, n in enumerate(discrete)]),
        vec([up.get("x", {}).get(n, s["x"][i]) for i, n in enumerate(states)]),
        ca.SX(up.get("next", math.inf)),
        ca.SX(up.get("terminate", 0)),
        ca.SX(up.get("reinit", 0)),
    ]
    functions = {
        "dependent": ([p], [d_of_p]),
        "start": ([p, d], [xs, vec(list(discrete.values())), vec(list(loops.values()))]),
        "initial": ([*env, x_given], [initial, ca.jacobian(initial, both)]),
        "derivatives": (env, [dx]),
        "jacobian": (
            env,
            [dx, with_diagonal(ca.jacobian(system, both), nx), ca.densify(ca.jacobian(system, s["t"]))],
        ),
        "loop": (env, [r, ca.jacobian(r, s["y"]), ca.densify(ca.jacobian(r, s["t"]))]),
        "slopes": (env, [with_diagonal(ca.jacobian(system, both), nx), ca.vertcat(*by_parameter.nonzeros())]),
        "element_slopes": (env, [ca.SX(0, 1)]),
        "move_partials": ([*env, *seeds([*"pd", *held])], [along(system, [*"pd", *held])]),
        "output_slopes": (env, [ca.vertcat(*shown.nonzeros())]),
        "variables": (env, [v]),
        "partials": ([*env, *seeds([*"xupdy", *held])], [along(dx, [*"xupdy", *held])]),
        "variable_partials": ([*env, *seeds([*"xupdy", *held])], [along(v, [*"xupdy", *held])]),
        "loop_partials": ([*env, *seeds([*"xupd", *held])], [along(r, [*"xupd", *held])]),
        "dependent_partials": ([p, seed["p"]], [along(d_of_p, "p")]),
        "start_partials": ([p, d, *seeds("pd")], [along(ca.vertcat(xs, vec(list(discrete.values()))), "pd")]),
        "initial_partials": (
            [*env, x_given, *seeds(["u", "p", "d", "xs", *held])],
            [along(initial, ["u", "p", "d", "xs", *held])],
        ),
        "indicator_partials": ([*env, *seeds(moving)], [along(g, moving)]),
        "update_partials": ([*env, init, *seeds(moving)], [along(ca.vertcat(*updated[:3]), moving)]),
        "indicators": (env, [g]),
        "update": ([*env, init], updated),
        "asserts": (env, [vec([f(e) for f, _, _ in asserts])]),
        "messages": (env, [vec([])]),
        "moved": (env, [vec([])]),
        "delayed": (env, [vec([])]),
        "delayed_partials": ([*env, *seeds(moving)], [vec([])]),
    }
    matrices = {"jacobian", "loop", "initial", "slopes"}
    made = {
        n: ca.Function("model_" + n, a, b if n in matrices else [ca.densify(x) for x in b])
        for n, (a, b) in functions.items()
    }
    lengths = {"X": nx, "U": nu, "P": np_, "D": nd, "Z": nz, "M": nm, "Y": ny, "V": nv, "ASSERT": len(asserts)}
    sizes = {f"N{letter}": n for letter, n in lengths.items()}
    sizes |= {"HAS_EVENTS": int(bool(update or relations)), "HAS_INITIAL": 0, "NDELAY": 0, "NTRANSPORT": 0}
    files = c_files(
        made,
        Header(
            sizes,
            x_nominal=[(nominal or {}).get(n, 1.0) for n in states],
            y_nominal=[1.0] * ny,
            inclusive=[False] * nm,
            groups=list(range(nm)),
            asserts=[(message, warning) for _, message, warning in asserts],
            shown=[0] * (len(asserts) + 1),
            slopes=Slopes(places(by_parameter), [], places(shown), [], [False] * nv),
            outputs=[True] * nv,
            points=[],
        ),
    )

    everything = [*states, *inputs]
    variables = [Variable("time", "Real", Location("t"), "independent", "continuous", unit="s")]
    for i, (n, start) in enumerate(states.items()):
        computed = callable(start)
        variables.append(
            Variable(
                n,
                "Real",
                Location("x", i),
                "local",
                "continuous",
                "approx" if computed else "exact",
                0.0 if computed else float(start),
                f"state {n}",
                nominal=(nominal or {}).get(n),
            )
        )
        variables.append(
            Variable(
                f"der({n})",
                "Real",
                Location("dx", i),
                "local",
                "continuous",
                "calculated",
                derivative_of=n,
                depends_on=tuple(everything),
            )
        )
    for i, (n, start) in enumerate(inputs.items()):
        variables.append(Variable(n, "Real", Location("u", i), "input", "continuous", "exact", start, unit="N.m"))
    for i, (n, start) in enumerate(parameters.items()):
        kind = "tunable" if n in tunable else "fixed"
        variables.append(Variable(n, "Real", Location("p", i), "parameter", kind, "exact", start))
    for i, n in enumerate(dependent):
        variables.append(Variable(n, "Real", Location("d", i), "calculatedParameter", "fixed", "calculated"))
    for i, n in enumerate(discrete):
        variables.append(Variable(n, "Real", Location("z", i), "local", "discrete", "calculated"))
    for i, n in enumerate(loops):
        variables.append(Variable(n, "Real", Location("y", i), "local", "continuous", "calculated"))
    for i, n in enumerate(outputs):
        variables.append(
            Variable(
                n,
                "Real",
                Location("v", i),
                "output",
                "continuous",
                "calculated",
                depends_on=tuple(everything),
            )
        )
    units = (Unit("N.m", (1, 2, -2, 0, 0, 0, 0, 0)), Unit("s", (0, 0, 1, 0, 0, 0, 0, 0)))
    return CompiledModel(
        name=name,
        class_name=f"Test.{name}",
        description=f"Test model {name}",
        variables=tuple(variables),
        units=units,
        experiment=Experiment(0.0, 1.0, 1e-6, 0.001),
        n_x=nx,
        n_u=nu,
        n_p=np_,
        n_d=nd,
        n_z=nz,
        n_m=nm,
        n_y=ny,
        n_v=nv,
        n_assert=len(asserts),
        has_events=bool(update or relations),
        has_initial=False,
        c_source=files.source,
        c_rare=files.rare,
        c_header=files.header,
        content_hash=hashlib.sha256((files.source + files.rare + files.header).encode()).hexdigest(),
        functions=made,
    )


def pendulum() -> CompiledModel:
    return compile_by_hand(
        "Pendulum",
        states={"phi": 1.0, "w": 0.0},
        inputs={"tau": 0.0},
        parameters={"m": 1.0, "l": 0.5, "damping": 0.1, "g": 9.81},
        dependent={"J": lambda e: e.m * e.l**2},
        rhs=lambda e: [e.w, (e.tau - e.damping * e.w - e.m * e.g * e.l * ca.sin(e.phi)) / e.J],
        outputs={
            "energy": lambda e: e.J * e.w**2 / 2 - e.m * e.g * e.l * ca.cos(e.phi),
            "through": lambda e: 2 * e.tau,
        },
    )


def train(name: str = "Train") -> CompiledModel:
    """Rotor - gear spring - housing on a torque sensor (1 kHz), with a stiff friction bristle: like the actuator."""

    def rhs(e):
        dtau = e.tau_bf * (e.b + 1e-5 * e.w)
        twist = 50 * e.phi_S - e.phi_R / 50  # flexspline
        tau_G = 25500 * twist + 70 * (50 * e.w_S - e.w / 50) * 0.01
        db = (e.w - ca.fabs(e.w) * e.b) / e.phi_s
        tau_S = 130000 * e.phi_S + e.d_S * e.w_S
        return [
            e.w,
            (e.K_m * e.i_cmd - dtau + tau_G / 50 * 0.02) / e.J_R,
            e.w_S,
            (-tau_S + 50 * e.K_m * e.i_cmd) / e.J_S,
            db,
        ]

    return compile_by_hand(
        name,
        states={"phi_R": 0.0, "w": 0.0, "phi_S": 0.0, "w_S": 0.0, "b": 0.0},
        inputs={"i_cmd": 0.0},
        parameters={"K_m": 0.7, "J_R": 2e-4, "J_S": 0.003, "d_S": 2.66, "tau_bf": 0.06, "phi_s": 1e-4},
        rhs=rhs,
        outputs={"tau_sensor": lambda e: 130000 * e.phi_S + e.d_S * e.w_S, "w_motor": lambda e: e.w - e.w_S},
    )


def robertson() -> CompiledModel:
    return compile_by_hand(
        "Robertson",
        states={"a": 1.0, "b": 0.0, "c": 0.0},
        nominal={"a": 1.0, "b": 1e-5, "c": 1.0},
        rhs=lambda e: [
            -0.04 * e.a + 1e4 * e.b * e.c,
            0.04 * e.a - 1e4 * e.b * e.c - 3e7 * e.b**2,
            3e7 * e.b**2,
        ],
        outputs={"total": lambda e: e.a + e.b + e.c},
    )


def van_der_pol() -> CompiledModel:
    return compile_by_hand(
        "VanDerPol",
        states={"x": 2.0, "v": 0.0},
        parameters={"mu": 1000.0},
        rhs=lambda e: [e.v, e.mu * ((1 - e.x**2) * e.v) - e.x],
        outputs={"y": lambda e: e.x},
    )


def pulled(rate: float = 1e9) -> CompiledModel:
    """x' = rate (cos t - x) - sin t, pulled to the slow motion cos t [Prothero, Robinson, 1974]."""
    return compile_by_hand(
        "Pulled",
        states={"x": 0.0},
        parameters={"rate": rate},
        rhs=lambda e: [e.rate * (ca.cos(e.time) - e.x) - ca.sin(e.time)],
        outputs={"y": lambda e: e.x},
    )


def oscillator() -> CompiledModel:
    """Without damping: x'' = -w^2 x."""
    return compile_by_hand(
        "Oscillator",
        states={"x": 1.0, "v": 0.0},
        parameters={"w": 1e4},
        rhs=lambda e: [e.v, -(e.w**2) * e.x],
        outputs={"y": lambda e: e.x},
    )


def bouncing_ball() -> CompiledModel:
    """h'' = -g with v := -e v on the ground; counts its bounces."""

    def update(e, init):
        hit = ca.logic_and(e.relation[0], ca.logic_not(e.pre_touching))
        return {
            "z": {"touching": e.relation[0], "bounces": e.pre_bounces + hit},
            "x": {"v": ca.if_else(hit, -e.restitution * e.v, e.v)},
            "reinit": hit,
        }

    return compile_by_hand(
        "BouncingBall",
        states={"h": 1.0, "v": 0.0},
        parameters={"restitution": 0.8, "g": 9.81},
        rhs=lambda e: [e.v, -e.g],
        discrete={"touching": 0.0, "bounces": 0.0},
        relations=lambda e: [-e.h],
        update=update,
        outputs={"height": lambda e: e.h},
    )


def sampled_counter() -> CompiledModel:
    """Samples an integrator every 0.1 s, ends the simulation at t = 0.95."""

    def update(e, init):
        due = e.time >= e.pre_next - 1e-12
        sample = ca.logic_and(due, ca.logic_not(init))
        return {
            "z": {
                "count": e.pre_count + sample,
                "held": ca.if_else(sample, e.x, e.pre_held),
                "next": ca.if_else(due, e.pre_next + 0.1, e.pre_next),
            },
            "next": ca.if_else(due, e.pre_next + 0.1, e.pre_next),
            "terminate": e.relation[0],
        }

    return compile_by_hand(
        "SampledCounter",
        states={"x": 0.0},
        inputs={"u": 1.0},
        rhs=lambda e: [e.u + 0 * e.held],
        discrete={"count": 0.0, "held": 0.0, "next": 0.0},
        relations=lambda e: [e.time - 0.95],
        update=update,
        outputs={"y": lambda e: e.held},
    )


def clock() -> CompiledModel:
    """x' = 1, counted at 0.05 + 0.1 k s; that is no number that sums of 0.05 reach exactly."""

    def update(e, init):
        due = ca.logic_and(e.time >= 0.05 + 0.1 * e.pre_count, ca.logic_not(init))
        count = e.pre_count + due
        return {"z": {"count": count, "held": ca.if_else(due, e.x, e.pre_held)}, "next": 0.05 + 0.1 * count}

    return compile_by_hand(
        "Clock",
        states={"x": 0.0},
        rhs=lambda e: [1 + 0 * e.held],
        discrete={"count": 0.0, "held": 0.0},
        update=update,
        outputs={"y": lambda e: e.held},
    )


def pulses() -> CompiledModel:
    """x' = 1 while sin(50 t) > 0.9: nothing else shortens the integrator's steps."""
    return compile_by_hand(
        "Pulses",
        states={"x": 0.0},
        rhs=lambda e: [ca.if_else(e.relation[0], 1, 0)],
        relations=lambda e: [ca.sin(50 * e.time) - 0.9],
        update=lambda e, init: {},
        outputs={"on": lambda e: e.relation[0]},
    )


def stick_slip() -> CompiledModel:
    """Mass dragged by a spring over Coulomb friction with the modes forward, stuck and backward.

    mode = 1 (forward), 0 (stuck), -1 (backward); a stuck mass starts beyond the static friction, a sliding one
    stops where its speed crosses zero.
    """

    def force(e):
        return e.c * (e.v0 * e.time - e.s)

    def update(e, init):
        forward, backward, above, below = (e.relation[i] for i in range(4))
        stuck = e.pre_mode == 0
        mode = ca.if_else(
            stuck,
            ca.if_else(above, 1, ca.if_else(below, -1, 0)),
            ca.if_else(
                ca.logic_or(
                    ca.logic_and(e.pre_mode == 1, ca.logic_not(forward)),
                    ca.logic_and(e.pre_mode == -1, ca.logic_not(backward)),
                ),
                0,
                e.pre_mode,
            ),
        )
        stop = ca.logic_and(mode == 0, ca.logic_not(stuck))
        return {"z": {"mode": mode}, "x": {"v": ca.if_else(stop, 0, e.v)}, "reinit": stop}

    return compile_by_hand(
        "StickSlip",
        states={"s": 0.0, "v": 0.0},
        parameters={"m": 1.0, "c": 100.0, "v0": 0.1, "f_slide": 1.0, "f_static": 1.5},
        # a starting mass has v = 0: forward means "not yet moving backward"
        rhs=lambda e: [
            ca.if_else(e.mode == 0, 0, e.v),
            ca.if_else(e.mode == 0, 0, (force(e) - e.mode * e.f_slide) / e.m),
        ],
        discrete={"mode": 0.0},
        relations=lambda e: [
            ca.if_else(e.mode == 1, e.v + 1e-9, e.v),
            ca.if_else(e.mode == -1, -e.v + 1e-9, -e.v),
            force(e) - e.f_static,
            -force(e) - e.f_static,
        ],
        update=update,
        outputs={"spring": force},
    )


def relay() -> CompiledModel:
    """Integrator whose direction follows a relation of the input: u > 0.5 up, else down."""
    return compile_by_hand(
        "Relay",
        states={"x": 0.0},
        inputs={"u": 0.0},
        rhs=lambda e: [ca.if_else(e.relation[0], 1, -1)],
        relations=lambda e: [e.u - 0.5],
        update=lambda e, init: {},
        outputs={"direction": lambda e: ca.if_else(e.relation[0], 1, -1)},
    )


def algebraic_loop() -> CompiledModel:
    """x' = -y with the loop y^3 + y = x + u."""
    return compile_by_hand(
        "AlgebraicLoop",
        states={"x": 2.0},
        inputs={"u": 0.0},
        parameters={"a": 1.0},
        rhs=lambda e: [-e.y],
        loops={"y": 0.0},
        loop=lambda e: [e.y**3 + e.a * e.y - e.x - e.u],
        outputs={"out": lambda e: 2 * e.y},
    )


def diode() -> CompiledModel:
    """Voltage y over a diode and a parallel resistor of 1 kOhm, fed with the current u + x: a loop that overflows."""
    return compile_by_hand(
        "Diode",
        states={"x": 0.0},
        inputs={"u": 0.0},
        rhs=lambda e: [0 * e.y],
        loops={"y": 0.0},
        loop=lambda e: [1e-9 * (ca.exp(e.y / 0.025) - 1) + e.y / 1e3 - e.x - e.u],
        outputs={"out": lambda e: e.y},
    )


def cubic() -> CompiledModel:
    """y^3 + a y = t - 1, nearly singular where it crosses zero; z is the integral of y."""
    return compile_by_hand(
        "Cubic",
        states={"z": 0.0},
        parameters={"a": 1e-6},
        rhs=lambda e: [e.y],
        loops={"y": -1.0},
        loop=lambda e: [e.y**3 + e.a * e.y - e.time + 1],
        outputs={"out": lambda e: e.y},
    )


def fold() -> CompiledModel:
    """y^2 = 1 - t: no solution after t = 1."""
    return compile_by_hand(
        "Fold",
        states={"z": 0.0},
        rhs=lambda e: [e.y],
        loops={"y": 1.0},
        loop=lambda e: [e.y**2 - 1 + e.time],
        outputs={"out": lambda e: e.y},
    )


def dependent_start() -> CompiledModel:
    """x' = -y from a start value that follows from parameters, y from the loop (1 + x) y + y^3 = b."""
    return compile_by_hand(
        "DependentStart",
        states={"x": lambda e: 2 * e.b + e.c},
        parameters={"b": 0.5},
        dependent={"c": lambda e: e.b**2},
        rhs=lambda e: [-e.y],
        loops={"y": 0.0},
        loop=lambda e: [(1 + e.x) * e.y + e.y**3 - e.b],
        outputs={"out": lambda e: e.x + e.y},
    )


def failing() -> CompiledModel:
    """Blows up at t = 1 (x' = x^2), has an asserted range and a root of a negative number in reach."""
    return compile_by_hand(
        "Failing",
        states={"x": 1.0, "w": 0.0},
        parameters={"limit": 1e300, "floor": -1e300},
        inputs={"u": 0.0},
        rhs=lambda e: [e.x**2, ca.sqrt(1 - e.u)],
        asserts=[
            (lambda e: e.x <= e.limit, "x must stay below its limit", False),
            (lambda e: e.x >= e.floor, "x is rather small", True),
        ],
        outputs={"y": lambda e: e.x},
    )


def one_sided_spring() -> CompiledModel:
    """Unit mass that flies to a stop at x = 0 of stiffness 1e6 N/m."""
    return compile_by_hand(
        "OneSidedSpring",
        states={"x": 1.0, "v": -1.0},
        rhs=lambda e: [e.v, 1e6 * ca.fmax(0, -e.x)],
        outputs={"force": lambda e: 1e6 * ca.fmax(0, -e.x)},
    )


def forced() -> CompiledModel:
    """x' = -x^2 + sin(3 t) + u: explicit dependence on time and on an input that may be a ramp."""
    return compile_by_hand(
        "Forced",
        states={"x": 1.0},
        inputs={"u": 0.0},
        rhs=lambda e: [-(e.x**2) + ca.sin(3 * e.time) + e.u],
        outputs={"y": lambda e: e.x},
    )
