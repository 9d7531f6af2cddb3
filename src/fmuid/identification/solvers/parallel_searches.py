"""Parallel searches: their next points are simulated together.

Every search runs in its own thread up to its next evaluations and waits there; only one thread runs at a time.
When all of them wait, their points are evaluated as one batch, in the order of the searches. The evaluations and
their order thus depend neither on the number of workers nor on the duration of a simulation.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Sequence
from queue import SimpleQueue

from fmuid.core.errors import SimulationError
from fmuid.identification.problem.evaluation import Evaluation
from fmuid.identification.solvers.search import Outcome, Search, Simulate, Status, StopSearch, Wish

_REMEMBERED = 8  # evaluations that one of many searches may request again


class Branch(Search):
    """One of several searches of the same problem. It counts and compares its own points; `ask` evaluates them.

    Each search draws its own random numbers.
    """

    def __init__(self, trunk: Search, number: int, ask: Simulate) -> None:
        seed = trunk.seed + number
        super().__init__(trunk.problem, trunk.stop, seed=seed, needs_residuals=trunk.needs_residuals)
        self.cost_of, self.limits_of, self.goals_of = trunk.cost_of, trunk.limits_of, trunk.goals_of
        self._remembered = _REMEMBERED
        self._simulate = ask

    def _check_budget(self) -> None:
        """Leave the stop rules to the trunk."""


class _Strand:
    """A search in a thread, run from one request to the next."""

    def __init__(self, trunk: Search, number: int, run: Callable[[Search], Outcome]) -> None:
        self.branch = Branch(trunk, number, self._ask)
        self.outcome: Outcome | None = None
        self.error: BaseException | None = None
        self._run = run
        self._wishes: SimpleQueue[Sequence[Wish] | None] = SimpleQueue()
        self._answers: SimpleQueue[list[Evaluation] | BaseException] = SimpleQueue()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def advance(self, answer: list[Evaluation] | BaseException | None = None) -> Sequence[Wish] | None:
        """Continue with an answer, or an exception in its place, to the next request; None at the end."""
        if answer is None:
            self._thread.start()
        else:
            self._answers.put(answer)
        return self._wishes.get()

    def end(self, reason: BaseException) -> None:
        """Make the search end, wherever it is."""
        if self._thread.is_alive():
            while self.advance(reason) is not None:
                pass

    def _ask(self, wanted: Sequence[Wish]) -> list[Evaluation]:
        self._wishes.put(wanted)
        answer = self._answers.get()
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def _work(self) -> None:
        try:
            self.outcome = self._run(self.branch)
        except SimulationError as error:  # ends this search, not the others
            self.outcome = Outcome(Status.FAILED, error.what)
        except StopSearch as stop:
            self.outcome = stop.outcome
        except BaseException as error:
            self.error = error
        self._wishes.put(None)


class ParallelSearches:
    """Parallel searches that share the evaluations of `trunk`.

    Parameters
    ----------
    trunk
        Search that counts, records, stops, and keeps the best point of all.
    runs
        The function that each search runs.
    """

    def __init__(self, trunk: Search, runs: Sequence[Callable[[Search], Outcome]]) -> None:
        self._trunk = trunk
        self._strands = [_Strand(trunk, number, run) for number, run in enumerate(runs)]

    def run(self) -> None:
        """Run all searches to their end.

        Raises
        ------
        StopSearch
            A stop rule of the trunk applies.
        """
        wishes: dict[int, Sequence[Wish]] = {}
        with warnings.catch_warnings():  # solvers change the filters and end in any order
            try:
                for k, strand in enumerate(self._strands):
                    self._note(wishes, k, strand.advance())
                while wishes:
                    answers = iter(self._trunk.evaluate_all([pair for wish in wishes.values() for pair in wish]))
                    for k, wish in list(wishes.items()):
                        self._note(wishes, k, self._strands[k].advance([next(answers) for _ in wish]))
            except BaseException as reason:
                for strand in self._strands:
                    strand.end(reason)
                raise

    def _note(self, wishes: dict[int, Sequence[Wish]], k: int, wish: Sequence[Wish] | None) -> None:
        wishes.pop(k, None)
        if wish is not None:
            wishes[k] = wish
        elif (error := self._strands[k].error) is not None:
            raise error

    @property
    def ended(self) -> list[tuple[Search, Outcome]]:
        """Every search and its outcome, in order."""
        return [(s.branch, s.outcome or Outcome(Status.INTERRUPTED, "stopped")) for s in self._strands]
