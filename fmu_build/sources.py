"""The Modelica files that belong to a class."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


def source_root(file: Path) -> Path | None:
    """Directory that a library path must contain for `file`'s package to be found; None for a separate file."""
    folder = file.resolve().parent
    if not (folder / "package.mo").exists():
        return None
    while (folder / "package.mo").exists():
        folder = folder.parent
    return folder


def source_files(file: Path, roots: Sequence[Path]) -> tuple[Path, ...]:
    """All sources that may be used, in a fixed order: `file`, its package, and every ``.mo`` below the roots."""
    files = {file.resolve()}
    root = source_root(file)
    if root is not None:
        package = file.resolve().relative_to(root).parts[0]
        files |= {p.resolve() for p in (root / package).rglob("*.mo")}
    for folder in roots:
        files |= {p.resolve() for p in Path(folder).rglob("*.mo")}
    return tuple(sorted(files))
