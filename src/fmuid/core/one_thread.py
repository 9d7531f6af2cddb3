"""Linear algebra in one thread."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


def in_one_thread(function: Callable[P, T]) -> Callable[P, T]:
    """Have a function do its linear algebra in one thread.

    Vectors and matrices are small here, and workers simulate on the other processors: more threads spend more time
    waiting for each other than they save, which doubles the processor time of a diagnosis.
    """

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> T:
        import scipy.linalg  # noqa: F401  (slow to import; brings another library, which is limited as well)
        from threadpoolctl import threadpool_limits

        with threadpool_limits(1, user_api="blas"):
            return function(*args, **kwargs)

    return limited
