"""Answers of a diagnosis in other names, so that effects that are the same count as one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any


def renamed(answer: Mapping[str, Any], name: Mapping[str, str]) -> dict[str, Any]:
    """Return an answer with effects named as `name` says; answers that then are the same set become one."""
    verdict, inclusion = answer["verdict"], dict[str, float]()
    effects = _named(verdict["effects"], name)
    one_of = list({frozenset(o): o for o in (_named(names, name) for names in verdict["one_of"])}.values())
    kind = verdict["kind"]
    if kind == "ambiguous" and len(one_of) == 1:
        kind, effects, one_of = "effect", _named((*effects, *one_of[0]), name), []
    for e in answer["effects"]:
        own = name.get(e["id"], e["id"])
        inclusion[own] = min(inclusion.get(own, 0.0) + e["probability"], 1.0)
    return {
        **answer,
        "verdict": {**verdict, "kind": kind, "effects": list(effects), "one_of": [list(o) for o in one_of]},
        "answers": _merged([{**a, "effects": list(_named(a["effects"], name))} for a in answer["answers"]]),
        "effects": [{"id": n, "probability": p} for n, p in inclusion.items()],
        "baselines": {k: list(_named(names, name)) for k, names in answer.get("baselines", {}).items()},
    }


def _merged(answers: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Join answers that are the same set of effects; their probabilities add up."""
    found: dict[frozenset[str], Mapping[str, Any]] = {}
    for a in answers:
        own = frozenset(a["effects"])
        before = found.get(own, {**a, "probability": 0.0})
        found[own] = {**before, "probability": before["probability"] + a["probability"]}
    return list(found.values())


def _named(names: Iterable[str], name: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name.get(n, n) for n in names))
