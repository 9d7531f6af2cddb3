"""Conversion of TOML tables to typed values; every error names its place."""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args

import msgspec

from fmu_build.suggest import suggestion
from fmuid.core.errors import CampaignError

MAX_BYTES = 10_000_000
SCHEMAS = "https://raw.githubusercontent.com/fmuid/fmuid/main/docs/schemas"  # of campaign.toml and effects.toml


class Table(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Base of a table's type; a key that it does not declare is an error."""


def read_toml(file: Path) -> dict[str, Any]:
    """Return the tables of a TOML file; CampaignError names the line if it cannot be read."""
    try:
        if file.stat().st_size > MAX_BYTES:
            raise CampaignError("is larger than 10 MB", where=file, fix="store measurements in a separate file")
        tables = tomllib.loads(file.read_bytes().decode())
    except FileNotFoundError:
        campaign = "campaign" in file.name or not file.suffix
        fix = (
            "give a folder with a campaign.toml, or make one with: fmuid init" if campaign else "correct its path"
        )
        raise CampaignError("no such file", where=file, fix=fix) from None
    except UnicodeDecodeError:
        raise CampaignError("is not UTF-8 text", where=file, fix="save it as UTF-8") from None
    except OSError as error:
        raise CampaignError(f"cannot be read ({error.strerror})", where=file, fix="check the path") from None
    except RecursionError:
        raise CampaignError("is nested too deeply", where=file, fix="flatten it") from None
    except ValueError as error:  # TOMLDecodeError, and Python's own limit on digits
        what, _, place = str(error).partition(" (at ")
        line = re.match(r"line (\d+)", place)
        where = f"{file} line {line[1]}" if line else f"{file} at its end" if place else str(file)
        what = what[:1].lower() + what[1:]
        raise CampaignError(f"is not TOML: {what}", where=where, fix="correct the line") from None
    for text in _texts(tables):
        if "\0" in text:
            raise CampaignError(f"{text!r:.80} contains a null character", where=file, fix="remove it")
    return tables


def _texts(value: Any) -> Iterator[str]:
    """Yield every key and every text below a TOML value."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        yield from value
        for inner in value.values():
            yield from _texts(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _texts(inner)


_T = TypeVar("_T", bound=Table)
_WORDS = {
    "float": "a number",
    "int": "a whole number",
    "str": "text",
    "bool": "true or false",
    "object": "a table",
    "array": "a list",
    "null": "nothing",
    "datetime": "a date",
}


def convert(table: Any, kind: type[_T], where: str) -> _T:
    """Return a raw table as the type `kind`; `where` names file and table in errors.

    Raises
    ------
    CampaignError
        A key is unknown or missing, or a value has the wrong type.
    """
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        message, _, place = str(error).partition(" - at `$")
        inside = "a value in " if "[" in place else ""
        key = place.strip(".`").partition("[")[0]
    if unknown := re.search(r"unknown field `(.*)`", message):
        fields = [f.encode_name for f in msgspec.structs.fields(kind)]
        raise CampaignError(f"unknown key '{unknown[1]}'", where=where, fix=suggestion(unknown[1], fields))
    if missing := re.search(r"missing required field `(.*)`", message):
        raise CampaignError(f"has no '{missing[1]}'", where=where, fix=f"write {missing[1]} = ...")
    if types := re.search(r"Expected `(.*)`, got `(.*)`", message):
        expected, got = (
            " or ".join(_WORDS.get(t.strip(), t.strip()) for t in side.split("|") if t.strip() != "null")
            for side in types.groups()
        )
        what = f"{inside}'{key}' is {got}" if key else f"is {got}"
        raise CampaignError(what, where=where, fix=f"write {expected}")
    if choice := re.search(r"Invalid enum value '?(.*?)'?$", message):
        choices = _choices(kind, key)
        raise CampaignError(f"'{key}' is '{choice[1]}'", where=where, fix=suggestion(choice[1], choices))
    raise CampaignError(f"'{key}': {message}", where=where, fix="correct the value")


def _choices(kind: type[Table], key: str) -> tuple[str, ...]:
    annotation = next((f.type for f in msgspec.structs.fields(kind) if f.encode_name == key), None)
    alternatives = (get_args(part) or (part,) for part in get_args(annotation))  # Literal[...], or that or None
    return tuple(choice for part in alternatives for choice in part if isinstance(choice, str))


def numbers(table: Mapping[str, Any], where: str, prefix: str = "") -> dict[str, float]:
    """Return a table of numbers; ``load.J = 1`` without quotes also means the variable ``load.J``."""
    values: dict[str, float] = {}
    for key, value in table.items():
        name = prefix + key
        if isinstance(value, dict):
            values |= numbers(value, where, f"{name}.")
        elif isinstance(value, (bool, int, float)):
            values[name] = finite(name, value, where)
        else:
            raise CampaignError(f"'{name}' is not a number", where=where, fix="write a number")
    return values


def finite(name: str, value: float, where: str) -> float:
    """Return `value` as a float; CampaignError if it is not finite."""
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise CampaignError(f"'{name}' is {number:g}", where=where, fix="write a finite number")
    return number


def toml_document(tables: Mapping[str, Any]) -> str:
    """Return tables as TOML text; tables nested deeper than ``[a.b]`` are written inline."""
    lines = [f"{toml_key(key)} = {_toml_value(v)}" for key, v in tables.items() if not isinstance(v, Mapping)]
    for key, table in tables.items():
        if not isinstance(table, Mapping):
            continue
        if table and all(isinstance(v, Mapping) for v in table.values()):
            named = [(f"{toml_key(key)}.{toml_key(inner)}", value) for inner, value in table.items()]
        else:
            named = [(toml_key(key), table)]
        for name, inside in named:
            lines += ["", f"[{name}]", *(f"{toml_key(k)} = {_toml_value(v)}" for k, v in inside.items())]
    return "\n".join(lines).lstrip("\n") + "\n"


def toml_key(name: str) -> str:
    """Return a key, quoted if necessary."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else toml_text(name)


def _toml_value(value: Any) -> str:
    if isinstance(value, Mapping):
        inside = ", ".join(f"{toml_key(k)} = {_toml_value(v)}" for k, v in value.items())
        return f"{{ {inside} }}" if inside else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml_value, value))}]"
    if isinstance(value, bool):
        return "true" if value else "false"
    return toml_text(value) if isinstance(value, str) else str(value)  # repr of a float, inf and nan too


def toml_text(value: str) -> str:
    """Return `value` as a TOML basic string."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
