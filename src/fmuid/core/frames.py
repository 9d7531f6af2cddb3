"""Conversion from and to data frames of pandas, polars and pyarrow, with narwhals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_args

import narwhals as nw

from fmuid.core.errors import FmuidError

Library = Literal["pandas", "polars", "pyarrow"]


def to_frame(columns: Mapping[str, Any], library: Library = "pandas") -> Any:
    """Return columns of equal length as a data frame.

    Parameters
    ----------
    columns
        Values by column name.
    library
        ``pandas``, ``polars`` or ``pyarrow``.

    Raises
    ------
    FmuidError
        The library is not installed or not supported.
    """
    if library not in get_args(Library):
        raise FmuidError(f"data frames of '{library}' are not supported", fix="choose pandas, polars or pyarrow")
    try:
        return nw.from_dict(dict(columns), backend=library).to_native()
    except ImportError:
        raise FmuidError(f"data frames need {library}", fix=f"pip install {library}") from None


def columns_of(frame: Any) -> dict[str, nw.Series[Any]]:
    """Return the columns of a data frame by name; a named pandas index becomes the first column.

    Raises
    ------
    FmuidError
        The object is not a data frame.
    """
    index = getattr(frame, "index", None)
    if getattr(index, "name", None) is not None:
        frame = frame.reset_index()
    try:
        found = nw.from_native(frame, eager_only=True)
    except TypeError:
        what = f"'{type(frame).__name__}' is not a data frame"
        raise FmuidError(what, fix="give a data frame of pandas, polars or pyarrow, or a path") from None
    return {str(name): found[name] for name in found.columns}
