"""The user's cache folder, for results that can be computed again."""

from __future__ import annotations

import os
import shutil
import time
from contextlib import suppress
from pathlib import Path

_UNUSED = 90 * 86_400.0  # s: work that goes on comes back to its models sooner


def user_cache() -> Path:
    """Return this user's cache folder."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "fmuid"


def remove_unused(folder: Path, pattern: str) -> None:
    """Remove the files and folders of a cache that have not been used for 90 days."""
    for path in folder.glob(pattern):
        with suppress(OSError):  # another process removes it, too
            if time.time() - path.stat().st_mtime > _UNUSED:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
