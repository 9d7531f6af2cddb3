"""An append-only file of records that survives a kill at any moment.

A record is its length, a checksum and its content (MessagePack). A kill can only cut the last one short, and
reading stops there.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from fmuid.core.errors import FmuidError
from fmuid.core.files import write_atomically

_HEAD = struct.Struct("<II")  # length and CRC-32 of the content
_LARGEST = 1 << 30


class JournalError(FmuidError):
    """A journal cannot be read or written, or the run that it records cannot be resumed."""


class Journal:
    """A file of records, open for appending.

    Parameters
    ----------
    path
        The file.
    magic
        First bytes of the file: the kind of journal and its version.
    end
        Continue after this position, which `records` gives; later content is dropped. None writes a new file and
        replaces an existing one.
    """

    def __init__(self, path: Path, magic: bytes, *, end: int | None = None) -> None:
        self.path = path
        if end is None:
            write_atomically(path, magic)
        self._end = len(magic) if end is None else end
        self._file = path.open("r+b", buffering=0)
        self._file.truncate(self._end)

    @property
    def size(self) -> int:
        """Size of the file, bytes."""
        return self._end

    @property
    def closed(self) -> bool:
        """Whether the journal is closed for appending."""
        return self._file.closed

    def append(self, content: Any, *, lasting: bool = False) -> int:
        """Append one record and return its position; a `lasting` record also survives a crash of the machine.

        Raises
        ------
        JournalError
            The disk is full. The journal is then closed; all earlier records are kept.
        """
        data = msgspec.msgpack.encode(content)
        begin = self._end
        # Unbuffered, because data accepted by the kernel survives the death of the process.
        record = memoryview(_HEAD.pack(len(data), zlib.crc32(data)) + data)
        end = begin + len(record)
        try:
            self._file.seek(begin)  # Ctrl-C may have left more of an earlier record
            while record:  # a disk that becomes full takes only a part
                record = record[os.write(self._file.fileno(), record) :]
            if lasting:
                os.fsync(self._file.fileno())
        except BaseException as error:
            with suppress(OSError):  # nothing may follow half a record
                os.ftruncate(self._file.fileno(), begin)
            if not isinstance(error, OSError):
                raise
            self._file.close()
            raise _unwritable(self.path, error) from None
        self._end = end
        return begin

    def read(self, position: int) -> Any:
        """Return the record at a position returned by `append` or `records`."""
        length, _ = _HEAD.unpack(os.pread(self._file.fileno(), _HEAD.size, position))
        return msgspec.msgpack.decode(os.pread(self._file.fileno(), length, position + _HEAD.size))

    def close(self, *, remove: bool = False) -> None:
        """Close the file, and remove it if the run is done.

        Raises
        ------
        JournalError
            The file cannot be removed.
        """
        self._file.close()
        if remove:
            try:
                self.path.unlink()
            except OSError as error:
                raise _unwritable(self.path, error) from None


def records(path: Path, magic: bytes, begin: int | None = None) -> Iterator[tuple[Any, int, int]]:
    """Yield the complete records of a journal, each with its start and end position.

    Reading starts at position `begin`, an end position of an earlier reading, or at the first record.

    Raises
    ------
    JournalError
        The file is not a journal of this kind and version.
    """
    with path.open("rb") as file:
        if file.read(len(magic)) != magic:
            fix = "remove it to start over, or choose another folder"
            raise JournalError("is not a journal of this version of fmuid", where=path, fix=fix)
        begin = file.seek(file.tell() if begin is None else begin)
        while len(head := file.read(_HEAD.size)) == _HEAD.size:
            length, checksum = _HEAD.unpack(head)
            data = file.read(length) if length < _LARGEST else b""
            if not data or len(data) != length or zlib.crc32(data) != checksum:
                return  # cut short by a kill, or followed by zeros after a power failure
            end = file.tell()
            yield msgspec.msgpack.decode(data), begin, end
            begin = end


def check_resumable(folder: Path, resume: bool, *, interrupted: bool, complete: bool) -> None:
    """Refuse to replace an interrupted run without being asked to, or to resume a complete one.

    Raises
    ------
    JournalError
        There is an interrupted run and `resume` is False, or a complete run and `resume` is True.
    """
    if interrupted and not resume:
        fix = "continue with --resume, or remove the folder to start over"
        raise JournalError("contains an interrupted run", where=folder, fix=fix)
    if resume and complete and not interrupted:
        raise JournalError("the run is complete", where=folder, fix="leave out --resume, or change --out")


def _unwritable(path: Path, error: OSError) -> JournalError:
    return JournalError(
        f"cannot be written ({error.strerror or error})",
        where=path,
        fix="free some disk space; --resume then continues the run where it stopped",
    )
