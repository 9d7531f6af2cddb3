"""Generated parts of the site: commands (by Typer), names of `fmuid`, catalogue of errors, numbers set by hand."""

from __future__ import annotations

import contextlib
import csv
import io
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

sys.path.append(str(Path(__file__).parents[1]))  # MkDocs removes it after this import
from benchmarks.chosen_numbers import table

_TOPICS = {
    "Campaigns and measurements": ("campaigns", "core.campaign", "core.experiments", "data"),
    "Simulation": ("simulation",),
    "How far to trust it": ("identification.validate", "identification.uncertainty"),
    "Identification": ("identification",),
    "Diagnosis": ("diagnosis_pipeline",),
}


def on_files(files: Files, config: Any) -> Files:
    """Add the two pages."""
    files.append(File.generated(config, "reference/cli.md", content=_commands()))
    files.append(File.generated(config, "reference/python.md", content=_names()))
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Insert generated tables into their pages."""
    made = {"errors.md": ("<!-- errors.csv -->", _errors), "numbers.md": ("<!-- numbers -->", table)}
    made["modelica.md"] = ("<!-- modelica_refused.csv -->", _refused)
    mark, content = made.get(page.file.src_uri, ("", str))
    return markdown.replace(mark, content()) if mark else markdown


def _rows(name: str) -> list[dict[str, str]]:
    with (Path(__file__).parent / name).open(newline="") as file:
        return list(csv.DictReader(file))


def _refused() -> str:
    lines = ["| what | example | message |", "|---|---|---|"]
    for row in _rows("modelica_refused.csv"):
        cells = (row["what"], f"`{row['example']}`", row["message"])
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines)


def _errors() -> str:
    rows = _rows("errors.csv")
    lines: list[str] = []
    for group in dict.fromkeys(row["group"] for row in rows):
        lines += [f"## {group}", "", "| what is wrong | seen by | the line |", "|---|---|---|"]
        for row in (r for r in rows if r["group"] == group):
            mark = "``" if "`" in row["line"] else "`"
            cells = (row["what is wrong"], f"`fmuid {row['fmuid command']}`", f"{mark}{row['line']}{mark}")
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        lines.append("")
    return "\n".join(lines)


def _commands() -> str:
    import typer
    from typer.cli import get_docs_for_click
    from typer.main import get_command

    from fmuid.cli.app import app

    command = get_command(app)
    with contextlib.redirect_stdout(io.StringIO()):
        text = get_docs_for_click(obj=command, ctx=typer.Context(command), name="fmuid", title="Command line")
    for name, one in command.commands.items():  # Typer cuts the sentences
        sentence = " ".join((one.help or "").split("\n\n")[0].split())
        text = re.sub(rf"^\* `{name}`: .*$", f"* `{name}`: {sentence}", text, flags=re.MULTILINE)
    text = re.sub(r"^Example: (.*)$", r"```sh\n\1\n```", text, flags=re.MULTILINE)
    return text.replace("\n# `fmuid`", "\n# Command line", 1)


def _names() -> str:
    import fmuid

    left = dict(fmuid._PUBLIC)
    lines = [
        "# Python",
        "",
        "What is public is in `fmuid`; its types are shipped (`py.typed`). Nothing is loaded before it is used.",
    ]
    for topic, modules in (*_TOPICS.items(), ("More", ("",))):
        names = [
            n for m in modules for n, place in left.items() if not m or place == m or place.startswith(f"{m}.")
        ]
        if names:
            lines += ["", f"## {topic}", ""] + [f"::: fmuid.{left.pop(n)}.{n}" for n in names]
    return "\n".join(lines) + "\n"
