"""Modelica source to rumoca's flat result; the only importer of rumoca."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from fmu_build.sources import source_files, source_root
from fmuid.errors import ModelicaError

Node = Mapping[str, Any]

# What rumoca's flat result consists of. A part not listed is something this translator does not know: refused.
_READ = {
    "variables", "variable_type_names", "variable_final_flags", "effective_types", "enumeration_types",
    "predefined_types", "enum_literal_ordinals", "equations", "structured_equations", "assert_equations",
    "initial_equations", "initial_structured_equations", "initial_assert_equations", "when_chains", "functions",
    "model_description", "top_level_connectors", "top_level_input_components", "parameter_branch_selections",
    "record_instances", "record_types", "is_partial",
}  # fmt: skip
_BOOKKEEPING = {
    "predefined_string_declaration", "type_ids_by_def_id", "enumeration_type_roots", "class_type",
    "instance_relations", "oc_break_edge_scalar_count",
}  # fmt: skip
_REFUSED = {
    "algorithms": "algorithm section of a model",
    "initial_algorithms": "initial algorithm section",
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
        return ModelicaError(what, where=self.where(span) or self.class_name, fix=fix)

    @cached_property
    def _texts(self) -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in self.files}

    @cached_property
    def _sources(self) -> dict[int, Path]:
        # rumoca numbers its sources without naming them: the file is the one whose text has the declared names
        # where the spans say.
        votes: dict[int, dict[Path, int]] = {}
        for name, variable in self.parts["variables"].items():
            span = variable["source_span"]
            ident = name.rpartition(".")[2].partition("[")[0].encode()
            for path, text in self._texts.items():
                hit = ident in text[span["start"] : span["end"]]
                poll = votes.setdefault(span["source"], {})
                poll[path] = poll.get(path, 0) + hit
        for function in (self.parts.get("functions") or {}).values():
            for variable in [*function["inputs"], *function["outputs"]]:
                span = variable["span"]
                for path, text in self._texts.items():
                    poll = votes.setdefault(span["source"], {})
                    hit = variable["name"].encode() in text[span["start"] : span["end"]]
                    poll[path] = poll.get(path, 0) + hit
        return {source: max(poll, key=lambda path: poll[path]) for source, poll in votes.items()}


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
    import rumoca

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
    try:
        session = rumoca.Session(roots=search)
        if root is None:  # by text: rumoca would take every .mo beside a file as source too
            model = session.loads(file.read_text(encoding="utf-8"), model=class_name)
        else:
            model = session.load(str(file.resolve()), model=class_name)
        parts: dict[str, Any] = model.to_dict("flat")
    except rumoca.RumocaError as error:
        raise _front_end_error(error, file) from None
    flat = Flat(class_name, parts, source_files(file, roots))
    _check_parts(flat)
    return flat


def _front_end_error(error: Exception, file: Path) -> ModelicaError:
    import rumoca

    for diagnostic in rumoca.validate_source(file.read_text(encoding="utf-8")):
        place = re.search(r"×\s*(.*?)\n.*?\[[^\]]*?:(\d+):\d+\]", diagnostic.message, re.DOTALL)
        if diagnostic.level == "error" and place:
            return ModelicaError(place.group(1), where=f"{file.name}:{place.group(2)}")
    message = str(error).split("\nRelated failures")[0].replace(f"{file.resolve().parent}/", "")
    return ModelicaError(message, where=file.name)


def _check_parts(flat: Flat) -> None:
    for name, value in flat.parts.items():
        if name in _REFUSED and value:
            span = value[0].get("span") if isinstance(value, list) and isinstance(value[0], dict) else None
            raise flat.error(f"{_REFUSED[name]} is not supported", span)
        if name not in _READ | _BOOKKEEPING | set(_REFUSED) and value:
            raise ModelicaError(f"the front end gave '{name}', which is not translated", where=flat.class_name)
    if flat.parts.get("is_partial"):
        raise ModelicaError("the class is partial", where=flat.class_name, fix="translate a class that extends it")
