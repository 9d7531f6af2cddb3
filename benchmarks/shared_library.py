"""C sources compiled on first use. Imports nothing of the tool that is checked."""

from __future__ import annotations

import hashlib
import os
import shlex
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

# No fused multiply-add and no -march: the same numbers on every x86-64 machine.
_FLAGS = ("-std=c11", "-O2", "-ffp-contract=off", "-fPIC", "-shared")


def compiled(name: str, *sources: Path, beside: Sequence[Path] = ()) -> Path:
    """Return the shared library of C sources, compiled if it is not in the cache; headers lie `beside` them."""
    text = b"".join(source.read_bytes() for source in (*sources, *beside))
    key = hashlib.sha256(text + " ".join(_FLAGS).encode()).hexdigest()[:16]
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fmuid"
    target = folder / f"{name}-{key}.so"
    if not target.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            built = Path(scratch) / target.name
            compiler = shlex.split(os.environ.get("CC") or "cc")
            subprocess.run([*compiler, *_FLAGS, "-o", str(built), *map(str, sources), "-lm"], check=True)
            built.replace(target)  # atomic: a second process sees all of it or nothing
    return target
