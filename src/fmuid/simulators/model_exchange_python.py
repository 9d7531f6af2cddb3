"""model_exchange.c in Python, sum by sum in the same order, where there is no C compiler."""

from __future__ import annotations

import ctypes
import math
from ctypes import c_bool, c_double, c_int, c_int32, c_size_t, c_void_p
from typing import TYPE_CHECKING, Any

from fmuid.simulators.stepper import Outcome

if TYPE_CHECKING:
    from fmuid.simulators.stepper_python import Run

_MAX_EVENT_ITERATIONS, _MAX_EVENTS, _MAX_BISECTIONS = 1000, 100_000, 60
_GAMMA = 0.25
_NODE = (0.0, 0.386, 0.21, 0.63, 1.0, 1.0)
_SLOPE = (0.25, -0.1043, 0.1035, -0.03620000000000023, 0.0, 0.0)
_A: tuple[tuple[float, ...], ...] = (
    (),
    (1.544,),
    (0.9466785280815826, 0.2557011698983284),
    (3.314825187068521, 2.896124015972201, 0.9986419139977817),
    (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950),
    (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950, 1.0),
)
_C: tuple[tuple[float, ...], ...] = (
    (),
    (-5.6688,),
    (-2.430093356833875, -0.2063599157091915),
    (-0.1073529058151375, -9.594562251023355, -20.47028614809616),
    (7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160),
    (8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136, -6.058818238834054),
)
_DENSE = (
    (10.12623508344586, -7.487995877610167, -34.80091861555747, -7.992771707568823, 1.025137723295662),
    (-0.6762803392801253, 6.087714651680015, 16.43084320892478, 24.76722511418386, -6.594389125716872),
)


class _EventInfo2(ctypes.Structure):
    """fmi2EventInfo."""

    _fields_ = (
        ("need", c_int),
        ("terminate", c_int),
        ("nominals", c_int),
        ("values", c_int),
        ("defined", c_int),
        ("next", c_double),
    )


class Integrator:
    """The states of one run and how they move; see model_exchange.c."""

    def __init__(self, run: Run) -> None:
        self.run, self.plan = run, run.plan
        n = self.n = int(self.plan.n_states)
        self.vector = (c_double * max(n, 1))()
        self.signals = (c_double * max(int(self.plan.n_indicators), 1))()
        self.x, self.nominal = [0.0] * n, [1.0] * n
        self.before: list[bool] = []
        self.step = float(run.time[1]) - float(run.time[0])
        self.input = run.inputs[0].copy()
        self.next_event: float | None = None
        self._settle(first=True)

    # ---- the FMU ----------------------------------------------------------------------------------------

    def _get(self, place: str) -> list[float]:
        self.run.do(place, (c_void_p, ctypes.addressof(self.vector)), (c_size_t, self.n))
        return list(self.vector[: self.n])

    def _set_point(self, k: int, t: float, x: list[float]) -> None:
        self.run.do("SET_TIME", (c_double, t))
        if self.plan.n_slopes:
            start, stop = float(self.run.time[k]), float(self.run.time[k + 1])
            s = (t - start) / (stop - start)
            u, v = self.run.inputs[k], self.run.inputs[k + 1]
            for j in self.run.slope_columns:
                self.input[j] = v[j] if t == stop else u[j] + s * (v[j] - u[j])
            self.run.set_slopes.set(self.input)
        if self.n:
            self.vector[: self.n] = x  # type: ignore[assignment]
            self.run.do("SET_STATES", (c_void_p, ctypes.addressof(self.vector)), (c_size_t, self.n))

    def _derivatives(self, k: int, t: float, x: list[float]) -> list[float]:
        self._set_point(k, t, x)
        return self._get("GET_DERIVATIVES")

    def _indicators(self) -> list[bool]:
        n = int(self.plan.n_indicators)
        if n:
            self.run.do("GET_INDICATORS", (c_void_p, ctypes.addressof(self.signals)), (c_size_t, n))
        return [z > 0 for z in self.signals[:n]]

    def _settle(self, first: bool = False) -> None:
        """From event mode, inputs being set, back to continuous-time mode."""
        again, changed, nominals = True, first, first
        count = 0
        while again:
            if count == _MAX_EVENT_ITERATIONS:
                self.run.end(Outcome.EVENTS_DO_NOT_SETTLE)
            count += 1
            if self.plan.fmi == 2:
                info = _EventInfo2()
                self.run.do("UPDATE_DISCRETE_STATES", (c_void_p, ctypes.addressof(info)))
                again, terminate = bool(info.need), bool(info.terminate)
                new_nominals, new_values, defined = info.nominals, info.values, info.defined
                next_event = info.next
            else:
                flags, time = [c_bool() for _ in range(5)], c_double()
                places = [ctypes.addressof(p) for p in flags] + [ctypes.addressof(time)]
                pointers = [(c_void_p, place) for place in places]
                self.run.do("UPDATE_DISCRETE_STATES", *pointers)
                again, terminate, new_nominals, new_values, defined = (f.value for f in flags)
                next_event = time.value
            self.next_event = next_event if defined else None
            if terminate:
                self.run.end(Outcome.TERMINATED)
            changed, nominals = changed or bool(new_values), nominals or bool(new_nominals)
        self.run.do("ENTER_CONTINUOUS_TIME_MODE")
        if self.n and changed:
            self.x = self._get("GET_STATES")
        if self.n and nominals:
            has = self.run.has("GET_NOMINALS")
            nominal = self._get("GET_NOMINALS") if has else [1.0] * self.n
            self.nominal = [abs(v) if v != 0 and math.isfinite(v) else 1.0 for v in nominal]
        self.before = self._indicators()

    # ---- one step ---------------------------------------------------------------------------------------

    def _linearise(self, k: int, t: float, h: float) -> None:
        self.f = self._derivatives(k, t, self.x)
        self.jacobian = [[0.0] * self.n for _ in range(self.n)]
        for j in range(self.n):
            trial = list(self.x)
            trial[j] = self.x[j] + 1.5e-8 * max(abs(self.x[j]), 1e-3 * self.nominal[j])
            moved = trial[j] - self.x[j]
            for i, value in enumerate(self._derivatives(k, t, trial)):
                self.jacobian[i][j] = (value - self.f[i]) / moved
        moved_time = t + 1e-4 * h
        moved = moved_time - t
        self.f_time = [
            (a - b) / moved for a, b in zip(self._derivatives(k, moved_time, self.x), self.f, strict=True)
        ]

    def _rodas(self, k: int, t: float, h: float) -> float:
        """Take one step; return its error over the tolerance, infinite if it cannot be taken."""
        n = self.n
        matrix = [[-v for v in row] for row in self.jacobian]
        for i in range(n):
            matrix[i][i] += 1 / (h * _GAMMA)
        pivots = _factor(matrix)
        if pivots is None:
            return math.inf
        self.stage: list[list[float]] = []
        for s in range(6):
            end = [_sum(self.x[i], _A[s], self.stage, i) for i in range(n)]
            f = self.f
            if s > 0:
                try:
                    f = self._derivatives(k, t + _NODE[s] * h, end)
                except self.run.Ended as ended:
                    if ended.outcome == Outcome.CALL_FAILED and self.plan.status == 2:
                        return math.inf
                    raise
            right = [f[i] + _sum(0.0, _C[s], self.stage, i) / h + h * _SLOPE[s] * self.f_time[i] for i in range(n)]
            _solve(matrix, pivots, right)
            self.stage.append(right)
        total = 0.0
        self.end = end
        for i in range(n):
            end[i] += self.stage[5][i]
            scale = self.plan.tolerance * (_greater(abs(self.x[i]), abs(end[i])) + 0.01 * self.nominal[i])
            part = self.stage[5][i] / scale
            total += part * part
            if not math.isfinite(end[i]):
                return math.inf
        return math.sqrt(total / n)

    def _interpolated(self, s: float) -> list[float]:
        return [
            self.x[i] * (1 - s) + s * (self.end[i] + (1 - s) * (self.dense1[i] + s * self.dense2[i]))
            for i in range(self.n)
        ]

    def _locate(self, k: int, t: float, h: float) -> float:
        """Shorten the step to the first crossing; the FMU is left just behind it."""
        low, high = 0.0, 1.0
        self.dense1, self.dense2 = ([_sum(0.0, row, self.stage, i) for i in range(self.n)] for row in _DENSE)
        for _ in range(_MAX_BISECTIONS):
            if not (high - low) * h > 1e-14 * (1 + abs(t)):
                break
            middle = 0.5 * (low + high)
            self._set_point(k, t + middle * h, self._interpolated(middle))
            if self._indicators() != self.before:
                high = middle
            else:
                low = middle
        if high < 1:
            self.end = self._interpolated(high)
            h *= high
        self._set_point(k, t + h, self.end)
        return h

    # ---- from one communication point to the next -------------------------------------------------------

    def _take_inputs(self, k: int, t: float) -> None:
        u = self.run.inputs[k]
        if (self.input != u).any():
            self.run.do("SET_TIME", (c_double, t))
            self.run.do("ENTER_EVENT_MODE")
            self.run.set_inputs.set(u)
            self.input[:] = u
            self._settle()

    def _completed(self) -> bool:
        """Tell the FMU that a step is complete; return whether it wants an event."""
        if not self.plan.completed_step_needed:
            return False
        kind: Any = c_int32 if self.plan.fmi == 2 else c_bool
        asked, ended = kind(), kind()
        pointers = [(c_void_p, ctypes.addressof(p)) for p in (asked, ended)]
        self.run.do("COMPLETED_INTEGRATOR_STEP", (kind, 1), *pointers)
        if ended.value:
            self.run.end(Outcome.TERMINATED)
        return bool(asked.value)

    def _advance(self, k: int, t: float, target: float) -> tuple[float, bool]:
        """Take an accepted step towards `target`; return its size and whether it reaches it."""
        wanted = self.step
        self._linearise(k, t, min(target - t, wanted))
        while True:
            left = target - t
            whole = 1.01 * wanted >= left
            step = left if whole else 0.5 * left if left < 2 * wanted else wanted
            error = self._rodas(k, t, step)
            ratio = math.sqrt(math.sqrt(error)) / 0.9 if math.isfinite(error) else 5.0
            proposed = step / min(5.0, max(1.0 / 6, ratio))
            if error <= 1:
                self.step = max(proposed, wanted) if ratio <= 1.0 / 6 else proposed
                return step, whole
            wanted = proposed
            if wanted < 1e-14 * (1 + abs(t)):
                self.plan.reached_time = t
                self.run.end(Outcome.STEP_TOO_SMALL)

    def integrate(self, k: int) -> None:
        """Go from communication point k to the next."""
        t, stop = float(self.run.time[k]), float(self.run.time[k + 1])
        self._take_inputs(k, t)
        events = 0
        while t < stop:
            time_event = self.next_event is not None and self.next_event < stop
            target = max(self.next_event, t) if time_event and self.next_event is not None else stop
            step, whole, enter = target - t, True, False
            if step > 0:
                self.end = []
                if self.n:
                    step, whole = self._advance(k, t, target)
                end = target if whole else t + step
                self._set_point(k, end, self.end)
                after = self._indicators()
                if after != self.before:
                    self.stage = self.stage if self.n else []
                    step = self._locate(k, t, step)
                    enter = True
                    time_event = time_event and t + step >= target
                    end = target if whole and t + step >= target else t + step
                    whole = end == target
                self.x = list(self.end)
                t = end
                self.plan.reached_time = t
                enter |= self._completed()
            if enter or (time_event and whole):
                events += 1
                if events > _MAX_EVENTS:
                    self.run.end(Outcome.EVENTS_DO_NOT_SETTLE)
                if step <= 0:
                    self.run.do("SET_TIME", (c_double, t))
                self.run.do("ENTER_EVENT_MODE")
                self._settle()


def _greater(a: float, b: float) -> float:
    """Return C's fmax: the number if one of them is none."""
    return b if math.isnan(a) else a if math.isnan(b) else max(a, b)


def _sum(start: float, weights: tuple[float, ...], stages: list[list[float]], i: int) -> float:
    for weight, stage in zip(weights, stages, strict=False):
        start += weight * stage[i]
    return start


def _factor(m: list[list[float]]) -> list[int] | None:
    n, pivots = len(m), []
    for c in range(n):
        best = c
        for r in range(c + 1, n):
            if abs(m[r][c]) > abs(m[best][c]):
                best = r
        pivots.append(best)
        if not abs(m[best][c]) > 0:
            return None
        m[c], m[best] = m[best], m[c]
        for r in range(c + 1, n):
            ratio = m[r][c] / m[c][c]
            m[r][c] = ratio
            for j in range(c + 1, n):
                m[r][j] -= ratio * m[c][j]
    return pivots


def _solve(m: list[list[float]], pivots: list[int], b: list[float]) -> None:
    n = len(m)
    for r in range(n):
        b[r], b[pivots[r]] = b[pivots[r]], b[r]
    for r in range(n):
        for j in range(r):
            b[r] -= m[r][j] * b[j]
    for r in reversed(range(n)):
        for j in range(r + 1, n):
            b[r] -= m[r][j] * b[j]
        b[r] /= m[r][r]
