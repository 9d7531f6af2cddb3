"""Read-only arrays and mappings."""

from __future__ import annotations

import copyreg
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


def read_only(values: ArrayLike) -> FloatArray:
    """Return a read-only, C-ordered float64 copy of `values`, or the array itself if it is all that already."""
    if (
        isinstance(values, np.ndarray)
        and values.base is None
        and values.dtype == np.float64
        and values.flags.c_contiguous
        and not values.flags.writeable
    ):
        return values
    array = np.array(values, dtype=np.float64, order="C", copy=True)
    array.flags.writeable = False
    return array


def frozen_mapping(mapping: Mapping[str, Any]) -> MappingProxyType[str, Any]:
    """Return a read-only copy of `mapping`, in its order."""
    return MappingProxyType(dict(mapping))


# Tasks are sent to other processes, and the standard library cannot pickle read-only mappings by itself.
copyreg.pickle(MappingProxyType, lambda mapping: (frozen_mapping, (dict(mapping),)))
