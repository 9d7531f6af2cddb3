"""Models and tasks packed for other processes, on this machine or another."""

from __future__ import annotations

import hashlib
import io
import pickle
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from fmuid.core import scratch
from fmuid.core.errors import FmuidError
from fmuid.simulation.simulator import Simulator, Task


@dataclass(frozen=True, slots=True)
class Parcel:
    """A pickled object and its SHA-256. It includes the content of files, so no shared disk is needed."""

    digest: str
    content: bytes
    name: str


class _Packer(pickle.Pickler):
    def persistent_id(self, thing: Any) -> Any:
        # An FMU, and a simulator made of several, is pickled as instructions to load it from files.
        return (thing.name, thing.read_bytes()) if isinstance(thing, Path) and thing.is_file() else None


class _Referrer(pickle.Pickler):
    def __init__(self, file: io.BytesIO, protocol: int, *, thing: Any, hold: Callable[[Any], int]) -> None:
        super().__init__(file, protocol)
        self._thing, self._hold = thing, hold

    def persistent_id(self, thing: Any) -> Any:
        # What a model is made of is sent once, however many models share it.
        inside = isinstance(thing, Simulator | Task) and thing is not self._thing
        return self._hold(thing) if inside else None


class _Unpacker(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, held: Mapping[int, Any]) -> None:
        super().__init__(file)
        self._held = held

    def persistent_load(self, pid: Any) -> Any:
        if isinstance(pid, int):
            return self._held[pid]
        name, content = pid
        path = Path(tempfile.mkdtemp(dir=scratch.of_process())) / name
        path.write_bytes(content)
        return path


def pickled(thing: Any, pickler: Callable[[io.BytesIO, int], pickle.Pickler] = pickle.Pickler) -> bytes:
    """Return `thing` as bytes; FmuidError if it cannot be pickled."""
    buffer = io.BytesIO()
    try:
        pickler(buffer, pickle.HIGHEST_PROTOCOL).dump(thing)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise FmuidError(
            f"cannot be sent to a worker process ({error})",
            where=type(thing).__name__,
            fix="define it in a module, or run in this process",
        ) from None
    return buffer.getvalue()


def packed(thing: Any) -> Parcel:
    """Return `thing` as a parcel; FmuidError if it cannot be pickled."""
    content = pickled(thing, _Packer)
    return Parcel(hashlib.sha256(content).hexdigest(), content, name_of(thing))


def referring(thing: Any, hold: Callable[[Any], int]) -> bytes:
    """Return `thing` as bytes that refer to models and tasks inside it by the numbers that `hold` gives them."""
    return pickled(thing, partial(_Referrer, thing=thing, hold=hold))


def unpacked(content: bytes, held: Mapping[int, Any] = MappingProxyType({})) -> Any:
    """Return the object packed in `content`, which may refer to objects that are held by number.

    FMUs of a parcel are written to the folder for temporary files.
    """
    return _Unpacker(io.BytesIO(content), held).load()


def name_of(simulator: Any) -> str:
    """Return a simulator's name for errors: the name of its file or class."""
    if isinstance(simulator, Parcel):
        return simulator.name
    files = simulator.files if isinstance(simulator, Simulator) else ()
    return files[0].name if files else type(simulator).__name__
