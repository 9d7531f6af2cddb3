"""Modelica source to rumoca's flat result; the only importer of rumoca."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from fmu_build import source_checks
from fmu_build.errors import ModelicaError
from fmu_build.source_locations import declared, locate
from fmu_build.sources import source_files, source_root
from fmu_build.suggest import suggestion

Node = Mapping[str, Any]
_LONG = 400  # of a message: what follows are its consequences
_ENOUGH = 40  # names to tell a source file by

# What rumoca's flat result consists of. A part not listed is something this translator does not know: refused.
_READ = {
    "variables", "variable_type_names", "variable_final_flags", "effective_types", "enumeration_types",
    "predefined_types", "enum_literal_ordinals", "equations", "structured_equations", "assert_equations",
    "initial_equations", "initial_structured_equations", "initial_assert_equations", "when_chains", "functions",
    "model_description", "top_level_connectors", "top_level_input_components", "parameter_branch_selections",
    "record_instances", "record_types", "algorithms", "initial_algorithms", "is_partial",
}  # fmt: skip
_BOOKKEEPING = {
    "predefined_string_declaration", "type_ids_by_def_id", "enumeration_type_roots", "class_type",
    "instance_relations", "oc_break_edge_scalar_count",
}  # fmt: skip
_REFUSED = {
    "definite_roots": "Connections.root",
    "branches": "Connections.branch",
    "optional_edges": "overconstrained connection",
    "potential_roots": "Connections.potentialRoot",
}


@dataclass(frozen=True)
class Flat:
    """A flattened Modelica class.

    Attributes
    ----------
    class_name
        Qualified name of the class.
    parts
        rumoca's flat result, a tree of dicts and lists.
    files
        Source files that took part, for the line numbers of messages.
    """

    class_name: str
    parts: Node
    files: tuple[Path, ...]

    def __getitem__(self, part: str) -> Any:
        return self.parts.get(part) or []

    def where(self, span: Any) -> str | None:
        """Return the source place of a span as ``file:line``; None if unknown."""
        if not isinstance(span, Mapping) or "start" not in span:
            return None
        path = self._sources.get(span["source"])
        if path is None:
            return None
        text = self._texts[path]
        line = text[: int(span["start"])].count(b"\n") + 1
        return f"{path.name}:{line}"

    def error(self, what: str, span: Any, fix: str | None = None) -> ModelicaError:
        """Make the error for a construct at a span."""
        where = self.where(span) or locate(what, self.class_name, self.files)
        return ModelicaError(what, where=where or self.class_name, fix=fix)

    def is_outer(self, variable: Node) -> bool:
        """Whether a variable is an ``outer`` declaration: the front end keeps it, but nothing refers to it."""
        span = variable["source_span"]
        path = self._sources.get(span["source"])
        before = b"" if path is None else self._texts[path][: int(span["start"])]
        return re.search(rb"\bouter\b[^;]*$", before[-200:]) is not None

    def used_files(self) -> list[Path]:
        """Source files that something in the flat result comes from."""
        return sorted(set(self._sources.values()))

    @cached_property
    def _texts(self) -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in self.files}

    @cached_property
    def _sources(self) -> dict[int, Path]:
        # rumoca numbers its sources without naming them: the file is the one whose text has the names where the
        # spans say.
        spans: dict[int, list[tuple[int, int, bytes]]] = {}

        def note(span: Node, name: str) -> None:
            known = spans.setdefault(span["source"], [])
            if len(known) < _ENOUGH:
                known.append((span["start"], span["end"], re.sub(r"\[[^\]]*\]", "", name).encode()))

        for name, variable in self.parts["variables"].items():
            note(variable["source_span"], name)
        for function in (self.parts.get("functions") or {}).values():
            for variable in [*function["inputs"], *function["outputs"]]:
                note(variable["span"], variable["name"])
        for equation in self["equations"]:
            # a class with equations only: the names it uses
            if len(spans.get(equation["span"]["source"], ())) < _ENOUGH:
                for name, span in references(equation["residual"]):
                    note(span, name)
        out = {}
        for source, known in spans.items():
            polls = {
                path: sum(_names(text[start:end], name) for start, end, name in known)
                for path, text in self._texts.items()
            }
            out[source] = max(polls, key=lambda path: polls[path])
        return out


def _names(text: bytes, name: bytes) -> int:
    """How well a piece of source fits a variable's name: 2 if it refers to it, 1 if it may declare it."""
    last = name.rpartition(b".")[2]
    if last not in text:
        return 0
    reference = re.sub(rb"\s|\[[^\]]*\]", b"", text)
    if re.fullmatch(rb"[\w.]+", reference) and (b"." + name).endswith(b"." + reference):
        return 2
    return int(re.search(rb"(?<!\w)" + re.escape(last) + rb"(?!\w)", text) is not None)


def references(tree: Any) -> Iterator[tuple[str, Node]]:
    """Yield name and span of every variable that an expression tree refers to."""
    if isinstance(tree, Mapping):
        if "VarRef" in tree:
            yield tree["VarRef"]["name"]["name"], tree["VarRef"]["span"]
        for child in tree.values():
            yield from references(child)
    elif isinstance(tree, list):
        for child in tree:
            yield from references(child)


def load(file: Path, class_name: str, roots: Sequence[Path] = ()) -> Flat:
    """Flatten a Modelica class.

    Parameters
    ----------
    file
        Source file that has the class, or the ``package.mo`` (or any file) of its package.
    class_name
        Qualified name of the class.
    roots
        Directories of further libraries; every ``.mo`` below them is source.

    Raises
    ------
    ModelicaError
        If a file is missing, the source is wrong, or the flat result has a part that is not translated.
    """
    file = Path(file)
    if file.is_dir():
        file /= "package.mo"
    if not file.is_file():
        raise ModelicaError("no such Modelica file", where=file)
    for folder in roots:
        if not Path(folder).is_dir():
            raise ModelicaError("no such library directory", where=folder)
    root = source_root(file)
    search = [str(Path(r).resolve()) for r in dict.fromkeys([*([root] if root else []), *roots])]
    request = {"file": str(file.resolve()), "class": class_name, "roots": search, "alone": root is None}
    # In a process of its own: rumoca may panic, write to stderr, or crash on source that it does not expect.
    run = subprocess.run(
        [sys.executable, "-m", "fmu_build.frontend"], input=json.dumps(request), capture_output=True, text=True
    )
    files = source_files(file, roots)
    if run.returncode != 0:
        source_checks.check([file], files)
        what = "the front end crashed on this class"
        raise ModelicaError(what, where=locate("", class_name, files) or f"{file.name}, {class_name}")
    answer = json.loads(run.stdout)
    if "panic" in answer:
        raise _panic(answer["panic"], file if root is None else None, class_name, files)
    if "error" in answer:
        raise _front_end_error(answer["error"], answer["places"], file, class_name, files)
    flat = Flat(class_name, answer["flat"], files)
    _check_parts(flat)
    source_checks.check([file, *flat.used_files()], files)
    return flat


def _flatten(request: Mapping[str, Any]) -> dict[str, Any]:
    """Run rumoca; what it says as plain values."""
    import rumoca

    file = Path(request["file"])
    text = file.read_text(encoding="utf-8")
    try:
        session = rumoca.Session(roots=request["roots"])
        if request["alone"]:  # by text: rumoca would take every .mo beside a file as source too
            model = session.loads(text, model=request["class"])
        else:
            model = session.load(str(file), model=request["class"])
        return {"flat": model.to_dict("flat")}
    except rumoca.RumocaError as error:
        found = [d.message for d in rumoca.validate_source(text) if d.level == "error"]
        return {"error": str(error), "places": found}
    except BaseException as error:  # a panic of rumoca derives from BaseException alone
        if type(error).__name__ != "PanicException":
            raise
        return {"panic": str(error)}


def _front_end_error(
    error: str, places: list[str], file: Path, class_name: str, files: Sequence[Path]
) -> ModelicaError:
    for message in places:
        place = re.search(r"×\s*(.*?)\n.*?\[[^\]]*?:(\d+):\d+\]", message, re.DOTALL)
        if place:
            return ModelicaError(place.group(1), where=f"{file.name}:{place.group(2)}")
    known = declared(files)
    if class_name not in known and "resolve/parse failed" in error:
        same = [k for k in known if k.rpartition(".")[2] == class_name.rpartition(".")[2]]
        fix = f"did you mean '{same[0]}'?" if same else suggestion(class_name, known)
        raise ModelicaError(f"there is no model '{class_name}'", where=file.name, fix=fix)
    message = error.split("\nRelated failures")[0].replace(f"{file.resolve().parent}/", "")
    message = re.sub(r"^\w+ failed: (?:\S+ failed in \w+: )?", "", " ".join(message.split()))
    own = re.search(r"\s*\[(\w+\.mo:\d+):\d+\]$", message)
    where = own.group(1) if own else locate(message, class_name, files) or f"{file.name}, {class_name}"
    message = message[: own.start()] if own else message
    return ModelicaError(message if len(message) <= _LONG else f"{message[:_LONG]} ...", where=where)


def _panic(text: str, file: Path | None, class_name: str, files: Sequence[Path]) -> ModelicaError:
    """Make a message of a failure inside rumoca; it names the byte where it gave up."""
    detail = re.search(r'detail: "(.*?)"', text)
    place = re.search(r"BytePos\((\d+)\)", text)
    what = f"the front end cannot translate this: {detail.group(1) if detail else text}"
    where = locate(what, class_name, files) or class_name
    if file is not None and place is not None:
        line = file.read_bytes()[: int(place.group(1))].count(b"\n") + 1
        where = f"{file.name}:{line}"
    return ModelicaError(what, where=where)


def _check_parts(flat: Flat) -> None:
    for name, value in flat.parts.items():
        if name in _REFUSED and value:
            span = value[0].get("span") if isinstance(value, list) and isinstance(value[0], dict) else None
            raise flat.error(f"'{_REFUSED[name]}' is not supported", span)
        if name not in _READ | _BOOKKEEPING | set(_REFUSED) and value:
            raise flat.error(f"the front end gave '{name}', which is not translated", None)
    if flat.parts.get("is_partial"):
        raise flat.error("the class is partial", None, "translate a class that extends it")


if __name__ == "__main__":
    json.dump(_flatten(json.load(sys.stdin)), sys.stdout)
