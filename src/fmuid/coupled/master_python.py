"""The loop of master.c in Python: the same calls in the same order, where there is no C compiler."""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Iterator
from ctypes import c_void_p
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmuid.coupled.layout import System
from fmuid.simulators.model_exchange_python import Integrator
from fmuid.simulators.stepper import Outcome
from fmuid.simulators.stepper_python import Run, RunEndedError, array_at

_EPSILON = float(np.finfo(float).eps)


class _Component:
    """One FMU: its run, the window of its inputs (2, n), its place among all outputs, what its inputs follow."""

    def __init__(self, system: System, c: int) -> None:
        self.run = Run(system.plans[c].contents)
        self.window = self.run.inputs
        places = array_at(system.places, system.n_components + 1, "i4")
        self.rows = slice(int(places[c]), int(places[c + 1]))
        self.links = [k for k in system.links[: system.n_links] if k.component == c]
        self.feeds = [f for f in system.feeds[: system.n_feeds] if f.component == c]
        self.state = c_void_p()
        self.known = False


class _Master:
    """One simulation; `system` holds its progress as it does in C."""

    def __init__(self, system: System) -> None:
        self.system = s = system
        self.components = [_Component(s, c) for c in range(s.n_components)]
        self.loops = [int(end) for end in array_at(s.loops, s.n_components, "i4")]
        self.time = array_at(s.time, s.n_times)
        self.steps = array_at(s.steps, s.n_times - 1, "i4").astype(float)
        self.signals = array_at(s.signals, s.n_times * s.n_signals).reshape(s.n_times, -1)
        self.predictions = array_at(s.outputs, s.n_records * s.n_times).reshape(s.n_records, s.n_times)
        self.window = array_at(s.window, 2)
        self.before, self.now, self.next = np.zeros((3, s.n_values))
        n = s.n_unknowns
        self.unknowns, self.residual, self.change = np.zeros((3, n))
        self.scale, self.inverse = np.full(n, 1e-6), -np.eye(n)

    def _failing(self, c: int) -> _Component:
        self.system.failed = c
        return self.components[c]

    def _follow(self, this: _Component, iterating: bool) -> None:
        s, h = self.system, self.window[1] - self.window[0]
        for k in this.links:
            begin = end = now = self.now[k.source]
            solved = iterating and k.unknown >= 0
            if s.gauss_seidel and self.components[k.from_].known and not solved:
                end = self.next[k.source]
                if not k.linear:
                    begin = end
            elif k.linear and s.step_before > 0:
                end = now + (now - self.before[k.source]) * (h / s.step_before)
            begin, end = k.factor * begin + k.offset, k.factor * end + k.offset
            if solved:
                end = self.unknowns[k.unknown]
                if not k.linear:
                    begin = end
            this.window[:, k.column] = begin, end

    def _feed(self, this: _Component) -> None:
        s = self.system
        n = self.steps[s.reached]
        for f in this.feeds:
            begin = end = self.signals[s.reached, f.signal]
            if f.linear:
                rise = self.signals[s.reached + 1, f.signal] - begin
                begin, end = begin + rise * (s.step / n), end + rise * ((s.step + 1) / n)
            this.window[:, f.column] = f.factor * begin + f.offset, f.factor * end + f.offset

    def _take_outputs(self, this: _Component) -> None:
        row, plan = self.next[this.rows], this.run.plan
        this.run.get_outputs.get(row)
        this.known = True
        bad = np.flatnonzero(~np.isfinite(row))
        if len(bad):
            plan.column, plan.reached_time = int(bad[0]), float(self.window[0 if plan.reached < 0 else 1])
            raise RunEndedError(Outcome.NOT_FINITE)

    def _step_one(self, c: int, iterating: bool) -> None:
        this = self._failing(c)
        self._feed(this)
        self._follow(this, iterating)
        this.run.plan.reached_time = float(self.window[0])
        if this.run.integrator is not None:
            this.run.integrator.integrate(0)
        else:
            this.run.do_step(0)
        self._take_outputs(this)

    def _initialise_one(self, c: int, iterating: bool) -> None:
        this = self._failing(c)
        for k in this.links:
            known = self.components[k.from_].known
            value = k.factor * self.next[k.source] + k.offset if known else k.start
            this.window[0, k.column] = self.unknowns[k.unknown] if iterating and k.unknown >= 0 else value
        this.run.set_inputs.set(this.window[0])
        this.known = True
        this.run.get_outputs.get(self.next[this.rows])

    def _links_of_loop(self, first: int, last: int) -> Iterator[Any]:
        return (
            k for k in self.system.links[: self.system.n_links] if k.unknown >= 0 and first <= k.component < last
        )

    def _solved(self, first: int, last: int, begins: bool) -> bool:
        solved = True
        for k in self._links_of_loop(first, last):
            i, value = k.unknown, k.factor * self.next[k.source] + k.offset
            self.residual[i] = value - self.unknowns[i]
            if begins and not math.isnan(value):
                self.scale[i] = max(self.scale[i], abs(value))
            allowed = self.system.tolerance * self.scale[i]  # a value whose rounding exceeds it proves nothing
            solved &= bool(abs(self.residual[i]) <= allowed and _EPSILON * abs(value) <= allowed)
        return solved

    def _learn(self, members: list[int], last: NDArray[np.float64]) -> None:
        moved, left, along = dict.fromkeys(members, 0.0), dict.fromkeys(members, 0.0), 0.0
        for a in members:
            for b in members:
                moved[a] += self.inverse[a, b] * (self.residual[b] - last[b])
                left[a] += self.change[b] * self.inverse[b, a]
            along += self.change[a] * moved[a]
        if along == 0 or not math.isfinite(along):
            return
        for a in members:
            for b in members:
                self.inverse[a, b] += (self.change[a] - moved[a]) * left[b] / along

    def _guess(self, first: int, last: int, initialising: bool) -> list[int]:
        s, h = self.system, self.window[1] - self.window[0]
        members = []
        for k in self._links_of_loop(first, last):
            members.append(int(k.unknown))
            value = self.now[k.source]
            if s.step_before > 0:
                value += (value - self.before[k.source]) * (h / s.step_before)
            self.unknowns[k.unknown] = k.start if initialising else k.factor * value + k.offset
        return members

    def _solve_loop(self, first: int, last: int, initialising: bool) -> None:
        members = self._guess(first, last, initialising)
        for c in range(first, last) if not initialising else ():
            this = self._failing(c)
            this.run.do("GET_FMU_STATE", (c_void_p, ctypes.addressof(this.state)))
        for iteration in range(self.system.iterations):
            for c in range(first, last) if iteration > 0 and not initialising else ():
                this = self._failing(c)
                this.run.do("SET_FMU_STATE", (c_void_p, this.state))
            for c in range(first, last):
                (self._initialise_one if initialising else self._step_one)(c, True)
            before = self.residual.copy()
            if self._solved(first, last, iteration == 0):
                return
            if iteration > 0:
                self._learn(members, before)
            for a in members:
                self.change[a] = 0.0
                for b in members:
                    self.change[a] -= self.inverse[a, b] * self.residual[b]
            for a in members:
                self.unknowns[a] += self.change[a]
        self._failing(first).run.plan.reached_time = float(self.window[0 if initialising else 1])
        raise RunEndedError(Outcome.LOOP_NOT_SOLVED)

    def _all(self, initialising: bool) -> None:
        c = 0
        while c < self.system.n_components:
            if self.loops[c]:
                self._solve_loop(c, self.loops[c], initialising)
                c = self.loops[c]
                continue
            (self._initialise_one if initialising else self._step_one)(c, False)
            c += 1

    def _settle_initialisation(self) -> None:
        s = self.system
        for attempt in range(s.iterations + s.n_links + 1):
            self.now[:] = self.next
            self._all(True)
            allowed = 0.0 if attempt < s.n_links + 2 else s.tolerance * np.abs(self.next)
            if attempt > 0 and bool(np.all(np.abs(self.next - self.now) <= allowed)):
                return
        self._failing(0).run.plan.reached_time = float(self.window[0])
        raise RunEndedError(Outcome.LOOP_NOT_SOLVED)

    def _record(self) -> None:
        s = self.system
        for i, r in enumerate(s.records[: s.n_records]):
            self.predictions[i, s.reached] = r.factor * self.now[r.source] + r.offset

    def _set_window(self) -> None:
        s, n = self.system, self.steps[self.system.reached]
        begin = self.time[s.reached]
        size = self.time[s.reached + 1] - begin
        self.window[0] = begin + size * (s.step / n)
        self.window[1] = self.time[s.reached + 1] if s.step + 1 == n else begin + size * ((s.step + 1) / n)
        for this in self.components:
            this.run.time = self.window

    def initialise(self) -> None:
        """Bring all FMUs from where they are to initialised, their connected inputs settled."""
        s = self.system
        s.reached, s.step, s.step_before = 0, 0, 0.0
        self._set_window()
        for c in range(s.n_components):
            this = self._failing(c)
            self._feed(this)
            this.run.enter_initialisation()
        self._settle_initialisation()
        for c in range(s.n_components):
            this = self._failing(c)
            this.run.do("EXIT_INITIALIZATION")
            if this.run.plan.model_exchange:
                this.run.integrator = Integrator(this.run)
        for c in range(s.n_components):
            this = self._failing(c)
            self._take_outputs(this)
            this.run.plan.reached = 0
        self.now[:] = self.next
        self._record()

    def step(self) -> None:
        """Take one communication step."""
        s = self.system
        self._set_window()
        for this in self.components:
            this.known = False
        self._all(False)
        self.before, self.now, self.next = self.now, self.next, self.before
        s.step_before = float(self.window[1] - self.window[0])
        s.step += 1
        if s.step == self.steps[s.reached]:
            s.step = 0
            s.reached += 1
            self._record()

    def close(self, outcome: Outcome) -> None:
        """Free states, and end the runs that are complete."""
        for c, this in enumerate(self.components):
            plan = this.run.plan
            dead = outcome == Outcome.CALL_FAILED and c == self.system.failed and plan.status > 3
            if this.state and not dead:
                this.run.call("FREE_FMU_STATE", (c_void_p, ctypes.addressof(this.state)))
            if outcome == Outcome.DONE and this.run.has("TERMINATE"):
                this.run.call("TERMINATE")


_runs: dict[int, _Master] = {}


def run(system: System, resume: int, seconds: float) -> int:
    """Simulate, or go on where the last call paused; returns PAUSED after about `seconds`."""
    key = ctypes.addressof(system)
    master = _runs.pop(key) if resume else _Master(system)
    outcome = Outcome.DONE
    begun = time.monotonic()
    try:
        if not resume:
            master.initialise()
        while system.reached < system.n_times - 1:
            master.step()
            if time.monotonic() - begun > seconds and system.reached < system.n_times - 1:
                _runs[key] = master
                return Outcome.PAUSED
    except RunEndedError as end:
        outcome = end.outcome
    master.close(outcome)
    return outcome
