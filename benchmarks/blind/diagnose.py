"""`python -m benchmarks.blind.diagnose CASE OUT [SECONDS]`: the diagnosing process of the blind check.

It knows a folder with logs and a model, calls ``fmuid init``, ``fmuid diagnose`` and ``fmuid validate`` as a user
does, and writes what they answered. A log that ``init`` refuses by name is left out, as a user would.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import resource
import sys
import time
from pathlib import Path
from typing import Any

_KEPT = (
    "version", "verdict", "gap", "best", "refinements", "equal", "model", "nominal", "corrected_differs",
)  # fmt: skip


def main() -> int:
    """Diagnose one case; return 0, or 3 where there is no answer."""
    case, out = Path(sys.argv[1]), Path(sys.argv[2])
    if len(sys.argv) > 3:
        resource.setrlimit(resource.RLIMIT_CPU, (int(sys.argv[3]), int(sys.argv[3])))
    order = json.loads((case / "order.json").read_text())
    begun, spent, record = time.monotonic(), _seconds(), {"refused": []}
    campaign, folder = out / "campaign", out / "diagnosis"
    logs = list(order["logs"])
    model = ["--model", str(case / order["model"]), "--class", order["class"]]
    while True:
        code, printed = _fmuid(
            "init", *(str(case / n) for n in logs), *model, "--out", str(campaign), "--workers", "0"
        )
        named = next((n for n in logs if re.search(rf"\b{re.escape(n)}\b", printed)), None) if code == 2 else None
        if code == 0 or named is None:
            break
        record["refused"].append([named, printed.strip()[-300:]])
        logs.remove(named)
    record |= {"init": code, "said": printed.strip()[-600:] if code else ""}
    if code == 0:
        code, printed = _fmuid(
            "diagnose", str(campaign), "--out", str(folder), "--workers", "0", *_tolerance(order)
        )
        record |= {"diagnose": code, "said": printed.strip()[-600:] if code else ""}
    record |= {"seconds": _seconds() - spent, "elapsed": time.monotonic() - begun}
    if code == 0:
        record["answer"] = reduced(json.loads((folder / "diagnosis.json").read_text()))
        record["free"] = re.findall(
            r'^\[parameters\."?([^"\]]*)"?\]', (campaign / "campaign.toml").read_text(), re.MULTILINE
        )
        validated = out / "validation.json"
        code, printed = _fmuid(
            "validate", str(folder / "diagnosis.json"), "--workers", "0", "--json", str(validated)
        )
        record["validate"] = json.loads(validated.read_text()) if validated.is_file() else printed.strip()[-300:]
    (out / "record.json").write_text(json.dumps(record, indent=1) + "\n")
    return 0 if "answer" in record else 3


def reduced(answer: dict[str, Any]) -> dict[str, Any]:
    """Reduce a diagnosis to the part that a score needs."""
    verdict = answer["verdict"]
    reported = {*verdict["effects"], *(e for s in verdict["one_of"] for e in s)}
    for one in answer["answers"][:5]:
        reported |= set(one["effects"])
    reported |= set((answer.get("best") or {}).get("effects", ()))
    kept = {k: answer[k] for k in _KEPT if k in answer}
    kept["law_found"] = {k: (answer.get("law_found") or {}).get(k) for k in ("formula", "reason", "closure")}
    kept["where"] = answer["where"][:4]
    kept["answers"] = answer["answers"][:8]
    kept["effects"] = [
        {k: e.get(k) for k in ("id", "probability", "closure", "parameters")}
        for e in answer["effects"]
        if e["id"] in reported
    ]
    return kept


def _fmuid(*words: str) -> tuple[int, str]:
    """Run a command in this process; return its exit code and what it wrote."""
    from fmuid.cli.app import run

    printed = io.StringIO()
    with contextlib.redirect_stderr(printed), contextlib.redirect_stdout(printed):
        try:
            code = run([*words, "--quiet"])
        except Exception as error:  # the program's fault: it is part of the record
            code = 70
            print(f"{type(error).__name__}: {error}")
    return code, printed.getvalue()


def _tolerance(order: dict[str, Any]) -> list[str]:
    """Return the options that state how exact the model has to be."""
    return [word for name, value in order["tolerance"].items() for word in ("--tolerance", f"{name}={value}")]


def _seconds() -> float:
    """Return the processor time spent so far, that of compilers included."""
    return sum(os.times()[:4])


if __name__ == "__main__":
    sys.exit(main())
