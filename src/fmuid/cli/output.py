"""Output of commands: text, tables and JSON."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from fmuid.core.errors import FmuidError
from fmuid.core.files import check_folder
from fmuid.core.progress import AS_LINES, PROGRESS_VARIABLE, progress_line

Json = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the result as JSON.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
Trust = Annotated[
    bool, typer.Option("--trust", help="Allow functions that the campaign names, which are its author's code.")
]
CampaignPath = Annotated[
    Path, typer.Argument(metavar="CAMPAIGN", help="A folder with a campaign.toml, or the file.")
]


def writable(context: typer.Context, place: Path | None) -> Path | None:
    """Refuse a folder or file that cannot be written, before the work begins.

    Raises
    ------
    FmuidError
        The folder cannot be made or written in.
    """
    if place is not None and not context.resilient_parsing:
        check_folder(place.parent if place.suffix else place)
    return place


class Printer:
    """Prints unless it is quiet, and writes the JSON file."""

    def __init__(self, quiet: bool = False, json_file: Path | None = None) -> None:
        if json_file is not None:
            check_folder(json_file.parent)
        self.quiet = quiet
        self.json_file = json_file

    def say(self, text: str) -> None:
        """Print one line."""
        if not self.quiet:
            typer.echo(text)

    def next(self, command: str, why: str) -> None:
        """Print the next command and its purpose."""
        self.say(f"next: {command}  ({why})")

    def table(self, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
        """Print rows under a header; numbers to the right, text to the left."""
        cells = [[_cell(v) for v in row] for row in rows]
        widths = [max(len(c) for c in column) for column in zip(header, *cells, strict=True)]
        right = [
            all(isinstance(v, (int, float)) or v is None for v in column) for column in zip(*rows, strict=True)
        ]
        right = right or [False] * len(header)
        for row in [list(header), *cells]:
            line = (c.rjust(w) if r else c.ljust(w) for c, w, r in zip(row, widths, right, strict=True))
            self.say("  ".join(line).rstrip())

    @contextmanager
    def working(self, what: str) -> Iterator[Callable[..., None]]:
        """Show progress on a terminal; yield a function of the fraction done (0 to 1) and a new text."""
        if os.environ.get(PROGRESS_VARIABLE) == AS_LINES:
            yield _write_line
            return
        if self.quiet or not sys.stderr.isatty():
            yield _say_nothing
            return
        from fmuid.core.status_line import Waiting

        with Waiting(what) as shown:
            yield shown

    def write(self, result: Mapping[str, Any]) -> None:
        """Write `result` to the JSON file, if requested; NaN and infinities become null."""
        if self.json_file is not None:
            from fmuid.core.files import write_atomically

            write_atomically(self.json_file, json.dumps(_plain(result), indent=2, allow_nan=False) + "\n")


def command_line(context: typer.Context) -> str:
    """Return the running command, quoted for a shell."""
    import shlex

    words: list[str] = []
    for parameter in context.command.params:
        name = str(parameter.name)
        source = context.get_parameter_source(name)
        if source is None or source.name != "COMMANDLINE":
            continue
        value = context.params[name]
        each = value if isinstance(value, list | tuple) else [value]
        if parameter.param_type_name == "argument":
            words[:0] = [str(v) for v in each]
        elif value is True:
            words.append(parameter.opts[0])
        else:
            words += [word for v in each for word in (parameter.opts[0], str(v))]
    return shlex.join(["fmuid", str(context.info_name), *words])


def pairs(texts: Sequence[str], option: str) -> dict[str, str]:
    """Return ``name=value`` texts as a mapping."""
    result = {}
    for text in texts:
        name, equals, value = text.rpartition("=")
        if not equals or not name.strip():
            raise FmuidError(f"'{text}' is not NAME=VALUE", where=option, fix=f"write it as in {option} d_S=2.66")
        result[name.strip()] = value.strip()
    return result


def numbers(texts: Sequence[str], option: str) -> dict[str, float]:
    """Return ``name=number`` texts as a mapping."""
    result = {}
    for name, value in pairs(texts, option).items():
        try:
            result[name] = float(value)
        except ValueError:
            raise FmuidError(
                f"'{value}' of '{name}' is not a number", where=option, fix="write a number"
            ) from None
        if not math.isfinite(result[name]):
            raise FmuidError(f"'{name}' is {value}", where=option, fix="write a finite number")
    return result


def _write_line(share: float, what: str = "") -> None:
    print(progress_line(share, what), file=sys.stderr, flush=True)


def _say_nothing(*_: object) -> None:
    """Discard all text."""


def _cell(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if hasattr(value, "tolist"):  # NumPy
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (str, int)):
        return value
    return str(value)
