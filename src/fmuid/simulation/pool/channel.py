"""Messages between a pool and its workers: array data is sent out of band, without pickling."""

from __future__ import annotations

import pickle
import select
import socket
import struct
from collections.abc import Sequence

import numpy as np

_HEAD = struct.Struct("<QQ")  # number of bytes in the message, number of buffers that follow


class Channel:
    """One end of a connection between two processes; `multiprocessing` can hand it to a new one."""

    def __init__(self, end: socket.socket) -> None:
        self._socket = end

    def fileno(self) -> int:
        """Return the descriptor to wait for."""
        return self._socket.fileno()

    def close(self) -> None:
        """Signal the end of messages to the other end."""
        self._socket.close()

    def send(self, packed: bytes, buffers: Sequence[pickle.PickleBuffer] = ()) -> None:
        """Send a pickled object and its out-of-band buffers; OSError if the other end is gone."""
        raw = [buffer.raw() for buffer in buffers]
        sizes = struct.pack(f"<{len(raw)}Q", *(view.nbytes for view in raw))
        self._socket.sendall(_HEAD.pack(len(packed) + len(sizes), len(raw)) + packed + sizes)
        for view in raw:
            self._socket.sendall(view)

    def send_all(self, messages: Sequence[bytes]) -> None:
        """Send pickled objects at once; OSError if the other end is gone."""
        self._socket.sendall(b"".join(_HEAD.pack(len(packed), 0) + packed for packed in messages))

    def waits(self) -> bool:
        """Return whether the next message, or the end, is there already."""
        return bool(select.select([self._socket], [], [], 0.0)[0])

    def receive(self) -> tuple[memoryview, list[memoryview]]:
        """Wait for a pickled object and its buffers; EOFError or OSError if the other end is gone."""
        size, number = _HEAD.unpack(self._exactly(_HEAD.size))
        packed = self._exactly(size)
        sizes = struct.unpack_from(f"<{number}Q", packed, size - 8 * number)
        return packed, [self._exactly(n) for n in sizes]

    def _exactly(self, size: int) -> memoryview:
        view = np.empty(size, np.uint8).data
        missing = view
        while missing:
            got = self._socket.recv_into(missing)
            if not got:
                raise EOFError
            missing = missing[got:]
        return view


def channels() -> tuple[Channel, Channel]:
    """Return the two ends of a new connection."""
    ours, theirs = socket.socketpair()
    return Channel(ours), Channel(theirs)
