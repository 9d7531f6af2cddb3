"""`help()` of what is public: every parameter and field is described, and what is raised."""

from __future__ import annotations

import inspect
import re

import pytest

import fmuid

NO_MISTAKE_POSSIBLE = {"measured_case"}  # raises nothing of its own


@pytest.mark.parametrize("name", sorted(fmuid.__all__))
def test_the_docstring_of_a_public_name(name: str) -> None:
    thing = getattr(fmuid, name)
    text = inspect.getdoc(thing) or ""
    assert text
    assert text.split("\n")[0].endswith((".", ":"))
    if inspect.isfunction(thing):
        described = [*inspect.signature(thing).parameters]
        assert "Raises\n---" in text or name in NO_MISTAKE_POSSIBLE
    else:
        described = [f for f in getattr(thing, "__dataclass_fields__", {}) if not f.startswith("_")]
        for method, value in vars(thing).items():
            if not method.startswith("_") and (inspect.isfunction(value) or isinstance(value, property)):
                assert inspect.getdoc(value), method
    assert [d for d in described if not re.search(rf"\b{d}\b", text)] == []
