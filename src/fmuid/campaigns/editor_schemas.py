"""JSON schemas of the TOML files, generated from the types that read them: editors complete and check with them.

``python -m fmuid.campaigns.editor_schemas FOLDER`` writes ``campaign.schema.json`` and ``effects.schema.json``.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import math
import re
import sys
from pathlib import Path
from typing import Any

import msgspec

from fmuid.campaigns import campaign_toml
from fmuid.core.campaign import CriterionSpec, DesignSpec, Limit, ModelSpec, ParameterSpec, StageSpec
from fmuid.core.files import write_atomically
from fmuid.core.toml_tables import SCHEMAS
from fmuid.effects import effects_file
from fmuid.effects.effect import Effect

FILES = {"campaign.schema.json": campaign_toml.document_type, "effects.schema.json": effects_file.document_type}
# Types of tables -> public types whose docstrings describe their fields.
_DESCRIBED = {
    "_ModelTable": ModelSpec,
    "_Parameter": ParameterSpec,
    "_ParameterTable": ParameterSpec,
    "_CriterionTable": CriterionSpec,
    "_Stage": StageSpec,
    "_LimitTable": Limit,
    "_DesignTable": DesignSpec,
    "_Effect": Effect,
}


def schema(name: str) -> dict[str, Any]:
    """Return the JSON schema of a kind of file, ``campaign.schema.json`` or ``effects.schema.json``."""
    (made,), components = msgspec.json.schema_components([FILES[name]()], ref_template="#/$defs/{name}")
    for title, component in components.items():
        texts = _field_texts(_DESCRIBED[title]) if title in _DESCRIBED else {}
        for key, field in component.get("properties", {}).items():
            if not _is_json(field.get("default")):
                del field["default"]
            if key in texts:
                field["description"] = texts[key]
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "$id": f"{SCHEMAS}/{name}"}
    document: dict[str, Any] = json.loads(msgspec.json.encode(head | dict(made) | {"$defs": components}))
    return document


def _is_json(value: Any) -> bool:
    return not isinstance(value, float) or math.isfinite(value)


def _field_texts(described: type) -> dict[str, str]:
    """Return the descriptions of fields in a numpydoc docstring."""
    names = {field.name for field in dataclasses.fields(described)}
    lines = (inspect.getdoc(described) or "").split("\n")
    texts: dict[str, str] = {}
    current: tuple[str, ...] = ()
    for line in lines:
        if line and not line[0].isspace():
            current = tuple(name for name in re.split(r", ", line) if name in names)
        elif line.strip():
            for name in current:
                texts[name] = f"{texts.get(name, '')} {line.strip()}".strip()
    return texts


def write(folder: Path) -> None:
    """Write all schemas into a folder."""
    for name in FILES:
        write_atomically(folder / name, json.dumps(schema(name), indent=1) + "\n")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
