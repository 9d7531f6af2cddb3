"""Atomic writing of files."""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from pathlib import Path

from fmuid.core.errors import FmuidError

_UNFINISHED = ".fmuid-unfinished"


def path_from(folder: Path, file: Path) -> str:
    """Return the path of a file from a folder, with slashes, as text files have it."""
    return Path(os.path.relpath(file.resolve(), folder.resolve())).as_posix()


def make_folder(folder: Path) -> None:
    """Make a folder and its parents if it does not exist.

    Raises
    ------
    FmuidError
        The folder cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        what = f"is not a usable folder ({error.strerror or error})"
        raise FmuidError(what, where=folder, fix="choose a folder that can be written") from None


def check_folder(folder: Path) -> None:
    """Raise an error early if a folder cannot be made or written to.

    Raises
    ------
    FmuidError
        A file is in its place, or this user has no permission to write there.
    """
    nearest = next((path for path in (folder, *folder.absolute().parents) if path.exists()), folder)
    if nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK):
        return
    reason = "no permission" if nearest.is_dir() else f"'{nearest}' is a file"
    raise FmuidError(f"is not a usable folder ({reason})", where=folder, fix="choose a folder that can be written")


def remove_unfinished(folder: Path, *, but_below: str) -> None:
    """Remove partly written files that a killed process left in a folder or below it.

    Folders below it that contain a file named `but_below` belong to other runs.
    """
    for path in folder.rglob(f".*{_UNFINISHED}"):
        if not any((above / but_below).exists() for above in path.parents if folder in above.parents):
            with suppress(OSError):
                path.unlink()


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write `content` to `path` atomically: a reader sees the old file or the new one, never a part.

    The folder is made if it is missing.

    Raises
    ------
    FmuidError
        The file cannot be written; no partial file remains.
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
        temporary.chmod(0o666 & ~umask)  # mkstemp creates private files
        temporary.replace(path)
    except OSError as error:
        raise FmuidError(
            f"cannot be written ({error.strerror or error})",
            where=path,
            fix="choose a folder that can be written",
        ) from None
    finally:
        if temporary is not None:
            with suppress(OSError):
                temporary.unlink()
