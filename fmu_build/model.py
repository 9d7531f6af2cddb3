# ruff: noqa: E501  (the tables of the interface are wider)
"""A compiled model: what the symbolic side hands over to the C runtime and the packaging.

The generated C
===============
``CompiledModel.c_source`` (written as ``model.c``), ``c_rare`` (``model_rare.c``: what a simulation seldom calls) and
``c_header`` (``model.h``) hold functions in CasADi's form::

    int model_NAME(const double** arg, double** res, casadi_int* iw, double* w, int mem);

with ``casadi_int`` = ``long long int``. They are pure (no memory, no global state, thread-safe), use libc and libm
only, and need work arrays of ``MODEL_SZ_ARG/RES/IW/W`` entries (macros in ``model.h``). A NULL ``res[i]`` is not
written. Vectors are dense. Of a matrix only the entries are written that may differ from zero, column by column: for
J, R and I below (the Jacobians of ``jacobian``, ``loop`` and ``initial``) ``model.h`` has where they are and the plan of
a factorisation (``MODEL_J_START[]`` etc., see ``runtime/linear.h``). **Every function exists in every model**; what a
model lacks has length zero (``MODEL_NX`` etc. may be 0, so give arrays one entry more).

Vectors (all double; Boolean 0/1, Integer and enumeration ordinals as whole numbers)

=====  ==================  ============================================================================================
name   length              meaning
=====  ==================  ============================================================================================
t      1                   time
x      MODEL_NX            continuous states
u      MODEL_NU            inputs
p      MODEL_NP            independent parameters (settable before initialisation)
d      MODEL_ND            dependent parameters, d = dependent(p)
z      MODEL_NZ            discrete-time variables, held between events (some are internal and have no Variable)
pz     MODEL_NZ            pre(z); equal to z outside event iteration
m      MODEL_NM            truth (0/1) of each relation outside noEvent, frozen during continuous integration
y      MODEL_NY            iteration variables of nonlinear algebraic loops, loop(...) = 0
v      MODEL_NV            every other variable (evaluated on request)
=====  ==================  ============================================================================================

``ENV`` stands for the nine arguments ``t, x, u, p, d, z, pz, m, y`` in this order (arg[0] .. arg[8]).

==================  =============================  =====================================================================
function            arguments                      results
==================  =============================  =====================================================================
dependent           p                              d
start               p, d                           xs (nx), z (nz), y (ny): start values; a caller may replace xs entries
                                                   by values set through FMI. pz = z at the start
initial             ENV, xs                        residual (nx+ny), I: its Jacobian with respect to [x; y];
                                                   only needed if MODEL_HAS_INITIAL is 1 (Newton from [xs; y]),
                                                   otherwise x = xs is the solution, y from loop
derivatives         ENV                            dx (nx)
jacobian            ENV                            dx (nx), J: [dx; r] by [x; y] with all of the first nx diagonal
                                                   entries, and [dx; r] by t (nx+ny); partial
loop                ENV                            r (ny), R: dr/dy, dr/dt (ny); Newton for y
slopes              ENV                            J; the entries of [dx; r] by [p; d; z = pz] that may differ from
                                                   zero, for scalars (MODEL_NSLOPE); partial
element_slopes      ENV                            the same for elements of arrays (MODEL_NELEMENT); where both are is in
                                                   MODEL_SLOPE_ROW[], MODEL_SLOPE_COLUMN[]
move_partials       ENV, sp, sd [Z]                directional derivative of [dx; r], x and y held; cheaper than slopes for
                                                   up to MODEL_FEW_SLOPE directions, and than element_slopes for up to
                                                   MODEL_FEW_ELEMENT
output_slopes       ENV                            the entries of v by [x; y; p; d; z = pz] that may differ from zero,
                                                   where v is an output (``MODEL_OUTPUT[i]`` is 1; MODEL_NOUTPUT_SLOPE);
                                                   those of other variables are in MODEL_CONSTANT[] where all are
                                                   constant (``MODEL_LINEAR[i]`` is 1); the places of both are in
                                                   MODEL_VARIABLE_ROW[], MODEL_VARIABLE_COLUMN[]
variables           ENV                            v (nv)
partials            ENV, sx, su, sp, sd, sy [Z]    directional derivative of dx (nx); [Z]: if nz > 0 follow sz, spz
variable_partials   ENV, sx, su, sp, sd, sy [Z]    directional derivative of v (nv)
loop_partials       ENV, sx, su, sp, sd [Z]        directional derivative of r (ny) with y held: sy solves
                                                   dr/dy sy = - this
dependent_partials  p, sp                          directional derivative of d (nd)
start_partials      p, d, sp, sd                   directional derivative of [xs; z] (nx+nz)
initial_partials    ENV, xs, su, sp, sd, sxs [Z]   directional derivative of the residual of ``initial``, x and y held
indicator_partials  ENV, SEEDS                     directional derivative of g (nm); SEEDS: sx, su, sp, sd, sy, sz, spz, st
update_partials     ENV, init, SEEDS               directional derivative of update's [z; x; next_event] (nz+nx+1)
indicators          ENV                            g (nm): relation i is true iff g_i > 0 (g_i >= 0 where
                                                   ``MODEL_INCLUSIVE[i]`` is 1)
update              ENV, init (1)                  z (nz), x (nx), next_event (1), terminate (1), reinit (1)
asserts             ENV                            a (MODEL_NASSERT): assertion i holds iff a_i is not 0
delayed             ENV                            what the entries of u behind the inputs remember: MODEL_NDELAY values of delay(),
                                                   then in0, in1 and x of each spatialDistribution() (MODEL_NTRANSPORT); then for
                                                   how long, and initial contents: see ``transports.py``
moved               ENV                            x of each spatialDistribution()
delayed_partials    ENV, SEEDS                     directional derivative of ``delayed``
messages            ENV                            values that the messages show (MODEL_NSHOWN); those of assertion i begin
                                                   at ``MODEL_SHOWN[i]``
==================  =============================  =====================================================================

Events (only if MODEL_HAS_EVENTS is 1). During integration m, z and pz = z are frozen; the indicators are watched, and
an event is where the truth of some g_i differs from m_i (the runtime adds its hysteresis), or where t reaches
``next_event`` (infinity: none). One event iteration at (t, x), u and p as they are::

    repeat                               # outer: pre-values
        repeat                           # inner: relations and discrete variables, mixed loops by fixed point
            solve loop for y             # if ny > 0
            z_new, x_new, ... = update(t, x, u, p, d, z, pz, m, y, init)
            solve loop for y again           # if ny > 0
            m_new = truth of indicators(t, x, u, p, d, z_new, pz, m, y)
            changed = z_new != z or m_new != m;  z = z_new;  m = m_new (see below from the 11th round on)
        until not changed                # report an error after e.g. 100 rounds
        again = z != pz or reinit;  pz = z;  if reinit: x = x_new
    until not again
    next_event = the last result of update

The plain fixed point of the inner loop can alternate for ever between two wrong modes of a friction element (forward:
it would move backward; backward: it would move forward) while the stuck mode between them is consistent. So from the
11th round on m takes fewer changes a round: the relations that turn false do; only where none turns false, the first
one that turns true does. (With all relations of its mode false, an element in the manner of BearingFriction is stuck.)
Where that does not settle either, a mode of a system with several solutions has ceased to exist (a Schmitt trigger jumps):
the runtime then tries the combinations of the relations that changed and of those in the same ``MODEL_GROUP[]``, those
with the fewest changes first, for one that is consistent. If rounding rules out each (the diodes of a bridge stop to conduct:
their modes meet), it takes the first one in which relations that do not fit are within the hysteresis of zero.

``update`` decides every when-clause by ``condition and not pre(condition)``, the pre-value being an internal entry of z,
so that calling it again with pz = z fires nothing. At initialisation: z = pz = start, m = truth of indicators with m =
0, solve the initial conditions, run the *inner* loop with ``init`` = 1 (when-clauses do not fire unless they name
``initial()``), repeat both until nothing changes, set pz = z, then do one whole event iteration with ``init`` = 0. If
``terminate`` is 1, the simulation ends as the model asked.

``model.h`` also has ``MODEL_HAS_EVENTS``, ``MODEL_HAS_INITIAL``, ``static const double MODEL_X_NOMINAL[]``,
``MODEL_Y_NOMINAL[]``, ``static const int MODEL_INCLUSIVE[]``, ``MODEL_OUTPUT[]``, the tables of slopes, ``static const char* const MODEL_ASSERT_MESSAGE[]`` (text
and source line; a value is the form between two characters 1, see ``fmu_build/messages.py``), ``static const int MODEL_ASSERT_WARNING[]`` (1: warn and go on), each with at least one entry.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

Type = Literal["Real", "Integer", "Boolean"]
Causality = Literal["input", "output", "parameter", "calculatedParameter", "local", "independent"]
Variability = Literal["constant", "fixed", "tunable", "discrete", "continuous"]
Initial = Literal["exact", "approx", "calculated"]
DependencyKind = Literal["constant", "fixed", "dependent"]
Vector = Literal["t", "x", "dx", "u", "p", "d", "z", "y", "v", "constant"]

BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


def derivative_name(name: str) -> str:
    """Return the name that FMI's structured names give the time derivative of a variable, or of a derivative."""
    known = re.fullmatch(r"der\((.+?)(?:,(\d+))?\)", name)
    return f"der({known[1]},{int(known[2] or 1) + 1})" if known else f"der({name})"


@dataclass(frozen=True)
class DisplayUnit:
    """Unit for showing a value: shown = factor * value + offset."""

    name: str
    factor: float
    offset: float = 0.0


@dataclass(frozen=True)
class Unit:
    """A unit in the SI base: value in base units = factor * value + offset.

    ``exponents`` follow `BASE_UNITS`; None where the unit string is not one of the SI's (then only its name is
    known and no ``BaseUnit`` is written).
    """

    name: str
    exponents: tuple[int, ...] | None
    factor: float = 1.0
    offset: float = 0.0
    display_units: tuple[DisplayUnit, ...] = ()


@dataclass(frozen=True)
class Location:
    """Location of a variable's value: sign * vector[index]; for "constant" the variable's ``start`` is its value.

    ``sign`` is -1 for a variable that is the negative of what is stored (setting it stores the negative). A
    Boolean alias has sign +1 only.
    """

    vector: Vector
    index: int = 0
    sign: Literal[1, -1] = 1


@dataclass(frozen=True)
class Variable:
    """One scalar variable of the model description.

    Attributes
    ----------
    start
        Start value where FMI wants one (inputs, parameters, constants, states with ``initial`` exact or approx), in
        ``unit``; for an enumeration its ordinal. None: no start attribute.
    derivative_of
        Name of the state this variable is the derivative of.
    depends_on
        For outputs and derivatives: names of the states and inputs it depends on; None elsewhere, and where events
        have a say (then it may depend on any).
    dependency_kinds
        How it depends on each of those names: linear with a number as factor (constant), with one that parameters
        decide (fixed), or otherwise (dependent); None: nothing is stated.
    enumeration
        Names of the literals if the type is an enumeration (``type`` is then "Integer"), else empty.
    """

    name: str
    type: Type
    location: Location
    causality: Causality
    variability: Variability
    initial: Initial | None = None
    start: float | None = None
    description: str = ""
    unit: str | None = None
    display_unit: str | None = None
    quantity: str | None = None
    min: float | None = None
    max: float | None = None
    nominal: float | None = None
    derivative_of: str | None = None
    depends_on: tuple[str, ...] | None = None
    dependency_kinds: tuple[DependencyKind, ...] | None = None
    enumeration: tuple[str, ...] = ()


@dataclass(frozen=True)
class Experiment:
    """The model's ``experiment`` annotation; None where it says nothing."""

    start: float | None = None
    stop: float | None = None
    tolerance: float | None = None
    interval: float | None = None


@dataclass(frozen=True)
class CompiledModel:
    """A Modelica model after symbolic reduction: C code, variables and sizes.

    Attributes
    ----------
    class_name, name, description
        Qualified Modelica class name, its last part (the FMU's model identifier), the class's description string.
    variables
        In declaration order, outputs and inputs among them; states and their derivatives always appear (a state
        derivative without a name in the model is called ``der(state)``); the order of ``x`` is that of the states.
    units
        Every unit named by a variable, sorted by name.
    c_source, c_rare, c_header
        Texts of ``model.c``, ``model_rare.c`` and ``model.h`` (see the module's docstring); the same bytes for the same input.
    content_hash
        SHA-256 (hex) over all that defines the model; the GUID follows from it.
    warnings
        What the user should know about the translation (one line each), e.g. start values taken as fixed.
    functions
        The CasADi functions by the names above, for checks from Python.
    """

    name: str
    class_name: str
    description: str
    variables: tuple[Variable, ...]
    units: tuple[Unit, ...]
    experiment: Experiment
    n_x: int
    n_u: int
    n_p: int
    n_d: int
    n_z: int
    n_m: int
    n_y: int
    n_v: int
    n_assert: int
    has_events: bool
    has_initial: bool
    c_source: str
    c_rare: str
    c_header: str
    content_hash: str
    warnings: tuple[str, ...] = ()
    functions: Mapping[str, Any] = field(default_factory=dict, repr=False, compare=False)
    n_delay: int = 0

    @property
    def needs_completed_step(self) -> bool:
        """Whether importers have to say when a step is completed, in model exchange."""
        return self.n_assert > 0 or self.n_delay > 0
