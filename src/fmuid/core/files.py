"""Files written whole or not at all."""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from pathlib import Path

from fmuid.core.errors import FmuidError

_UNFINISHED = ".fmuid-unfinished"


def user_cache() -> Path:
    """Return the folder in which results that can be made again are kept for this user."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "fmuid"


def make_folder(folder: Path) -> None:
    """Make a folder, with those above it, unless it is there.

    Raises
    ------
    FmuidError
        It cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        what = f"cannot be a folder ({error.strerror or error})"
        raise FmuidError(what, where=folder, fix="name a folder that can be written") from None


def check_folder(folder: Path) -> None:
    """Refuse a folder that cannot be made or written in, before there is something to write.

    Raises
    ------
    FmuidError
        Something else than a folder is in its place, or the folder above it does not let this user write.
    """
    nearest = next((path for path in (folder, *folder.absolute().parents) if path.exists()), folder)
    if nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK):
        return
    reason = "no permission" if nearest.is_dir() else f"'{nearest}' is a file"
    raise FmuidError(f"cannot be a folder ({reason})", where=folder, fix="name a folder that can be written")


def remove_unfinished(folder: Path) -> None:
    """Remove the beginnings of files that a killed process has left in a folder."""
    for path in folder.glob(f".*{_UNFINISHED}"):
        with suppress(OSError):
            path.unlink()


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write `content` to `path` so that a reader sees the old file or the new one, never half of it.

    The folder is made if it is missing.

    Raises
    ------
    FmuidError
        The file cannot be written there; nothing is left behind.
    """
    data = content.encode() if isinstance(content, str) else content
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}-", suffix=_UNFINISHED)
        temporary = Path(name)
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)  # mkstemp makes private files
        temporary.replace(path)
    except OSError as error:
        raise FmuidError(
            f"cannot be written ({error.strerror or error})",
            where=path,
            fix="name a folder that can be written",
        ) from None
    finally:
        if temporary is not None:
            with suppress(OSError):
                temporary.unlink()
