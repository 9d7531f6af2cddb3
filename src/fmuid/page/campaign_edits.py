"""Edits of a `campaign.toml` that keep its comments and can be undone."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AbstractTable

from fmuid.core.errors import CampaignError
from fmuid.core.files import write_atomically
from fmuid.core.toml_tables import toml_text

_REASON = re.compile(r"^# Fixed: (.*)\.$")  # above tables that are commented out
_REASON_OF_KNOWN = re.compile(r"^free = false # (.*)$")
_TABLE = re.compile(r'^(?:# )?\[parameters\."?([^"\]]+)"?\]')


class CampaignFile:
    """A `campaign.toml` on disk; every edit is written at once.

    Parameters
    ----------
    path
        The file.

    Raises
    ------
    CampaignError
        The file cannot be read, or an edit would not be TOML.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.text = self._read()
        self._before: list[str] = []
        self._after: list[str] = []

    @property
    def tables(self) -> Mapping[str, Any]:
        """The file's tables as plain values; none if it is not TOML at present."""
        try:
            return tomlkit.parse(self.text).unwrap()
        except TOMLKitError:
            return {}

    def reload(self) -> bool:
        """Take over what another program has written; return whether it did."""
        text = self._read()
        if text == self.text:
            return False
        self._before.append(self.text)
        self._after.clear()
        self.text = text
        return True

    def replace(self, text: str) -> None:
        """Write a new text.

        Raises
        ------
        CampaignError
            The text is not TOML; nothing is written.
        """
        try:
            tomlkit.parse(text)
        except TOMLKitError as error:
            what = str(error)
            raise CampaignError(
                f"is not TOML: {what[:1].lower()}{what[1:]}", where=self.path, fix="correct the line"
            ) from None
        if text != self.text:
            self._before.append(self.text)
            self._after.clear()
            self._write(text)

    def set(self, keys: Sequence[str | int], value: Any) -> None:
        """Set the value at a path of keys, or remove it if it is None; missing tables are made."""
        self.set_all({tuple(keys): value})

    def set_all(self, values: Mapping[tuple[str | int, ...], Any]) -> None:
        """Set several values in one edit; see `set`."""
        self.reload()
        document = tomlkit.parse(self.text)
        for keys, value in values.items():
            table: Any = document
            for key in keys[:-1]:
                if not isinstance(key, int) and key not in table:
                    table[key] = tomlkit.table(is_super_table=table is document and len(keys) > 2)
                table = table[key]
            if value is None:
                table.pop(keys[-1], None)
            elif not (keys[-1] in table and table[keys[-1]] == value and not isinstance(value, bool)):
                _assign(table, keys[-1], value)
        self.replace(tomlkit.dumps(document))

    @contextmanager
    def one_edit(self) -> Iterator[None]:
        """Make all edits of the block one, for `undo`."""
        self.reload()
        edits = len(self._before)
        try:
            yield
        finally:
            del self._before[edits + 1 :]

    def free(self, name: str, text: str) -> None:
        """Make a parameter free: uncomment its table if the file has it, or add `text`."""
        self.reload()
        table = self.tables.get("parameters", {}).get(name)
        if table is not None:
            self.set_all({("parameters", name, key): None for key in ("free", "known")})
            return
        lines = self.text.split("\n")
        heads = (f"# [parameters.{toml_text(name)}]", f"# [parameters.{name}]")
        begin = next((k for k, line in enumerate(lines) if line.startswith(heads)), None)
        if begin is None:
            self.replace(self.text.rstrip("\n") + "\n\n" + text.strip("\n") + "\n")
            return
        end = begin
        while end < len(lines) and lines[end].startswith("# "):
            lines[end] = lines[end][2:]
            end += 1
        self.replace("\n".join(lines))

    def reasons(self) -> dict[str, str]:
        """Return why `fmuid init` fixed a parameter, from the comments that it wrote."""
        reasons: dict[str, str] = {}
        reason = name = ""
        for line in self.text.split("\n"):
            if match := _REASON.match(line):
                reason = match[1]
            elif match := _TABLE.match(line):
                name = match[1]
                reasons |= {name: reason} if line.startswith("#") else {}
            elif match := _REASON_OF_KNOWN.match(line):
                reasons[name] = match[1]
        return reasons

    def undo(self) -> bool:
        """Return to the text before the last edit; return whether there was one."""
        return self._step(self._before, self._after)

    def redo(self) -> bool:
        """Repeat the edit that was undone last; return whether there was one."""
        return self._step(self._after, self._before)

    @property
    def can_undo(self) -> bool:
        """Whether there is an edit to undo."""
        return bool(self._before)

    @property
    def can_redo(self) -> bool:
        """Whether there is an edit to repeat."""
        return bool(self._after)

    def _step(self, source: list[str], target: list[str]) -> bool:
        if not source:
            return False
        target.append(self.text)
        self._write(source.pop())
        return True

    def _write(self, text: str) -> None:
        write_atomically(self.path, text)
        self.text = text

    def _read(self) -> str:
        try:
            return self.path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8"
            raise CampaignError(f"cannot be read ({reason})", where=self.path, fix="check the path") from None


def _assign(table: AbstractTable, key: Any, value: Any) -> None:
    """Set a value and keep the comment on its line."""
    old = table.get(key)
    item = tomlkit.item(value)
    if old is not None and hasattr(old, "trivia") and hasattr(item, "trivia"):
        item.trivia.comment, item.trivia.comment_ws = old.trivia.comment, old.trivia.comment_ws
    table[key] = item
