"""FMU code runs in supervised worker processes: the runner of the commands that simulate, and its options."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from fmuid.simulation.runners import Runner

Workers = Annotated[
    int | None,
    typer.Option(
        min=0,
        help=(
            "Number of worker processes, in which a crashing FMU costs one evaluation (default: one per"
            " processor; 0: none)."
        ),
    ),
]
TimeLimit = Annotated[float | None, typer.Option(min=0.0, help="Longest time per simulation, s (default: 300).")]
MemoryLimit = Annotated[
    int | None,
    typer.Option(
        min=1,
        metavar="MB",
        help="Largest memory per worker, MB (default: an equal share of half of the machine's memory).",
    ),
]


@contextmanager
def supervised(
    workers: int | None = None, time_limit: float | None = None, memory_limit: int | None = None
) -> Iterator[Runner]:
    """Yield the runner of a command's simulations; `memory_limit` in MB."""
    from fmuid.simulation.pool.choice import runner_on

    with runner_on(workers, time_limit=time_limit, memory_limit=in_bytes(memory_limit)) as runner:
        yield runner


def in_bytes(megabytes: int | None) -> int | None:
    """Return a limit in bytes."""
    return None if megabytes is None else megabytes * 2**20
