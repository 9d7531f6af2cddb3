"""Conversion from and to data frames of pandas, polars and pyarrow."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any, Literal, get_args

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
        module = import_module(library)
    except ImportError:
        raise FmuidError(f"data frames need {library}", fix=f"pip install {library}") from None
    return (module.table if library == "pyarrow" else module.DataFrame)(dict(columns))


def columns_of(frame: Any) -> dict[str, Any]:
    """Return the columns of a data frame by name; a named pandas index becomes the first column.

    Raises
    ------
    FmuidError
        The object is not a data frame, or two of its columns have one name.
    """
    libraries = {base.__module__.partition(".")[0] for base in type(frame).__mro__}
    if libraries.isdisjoint(get_args(Library)) or len(getattr(frame, "shape", ())) != 2:
        what = f"'{type(frame).__name__}' is not a data frame"
        raise FmuidError(what, fix="give a data frame of pandas, polars or pyarrow, or a path")
    index = getattr(frame, "index", None)
    if getattr(index, "name", None) is not None:
        frame = frame.reset_index()
    names = list(frame.column_names if "pyarrow" in libraries else frame.columns)
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise FmuidError(f"the data frame has two columns '{twice[0]}'", fix="rename one")
    return {str(name): frame[name] for name in names}
