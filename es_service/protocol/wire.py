"""Messages over a stream socket, between a driver and a worker on the same machine: eight bytes of length, a pickle.

A leaf of the import graph. The worker's end waits; the driver's never does, whatever state the worker is in.
"""

from __future__ import annotations

import pickle
import socket
import struct
from collections import deque
from contextlib import suppress
from typing import Any

_LENGTH = struct.Struct("!Q")
_READ_BYTES = 1 << 18
BUFFER_BYTES = 1 << 20
"""What sockets are asked to hold, so that most messages are sent at once; the system may grant less."""


def framed(message: Any) -> bytes:
    """A message as it travels."""
    body = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
    return _LENGTH.pack(len(body)) + body


def receive(end: socket.socket) -> Any:
    """The next message of a socket that waits.

    Raises:
        EOFError: the other end is closed. OSError: it broke.
    """
    (length,) = _LENGTH.unpack(_exactly(end, _LENGTH.size))
    return pickle.loads(_exactly(end, length))


def _exactly(end: socket.socket, count: int) -> bytearray:
    data = bytearray(count)
    view = memoryview(data)
    while view:
        read = end.recv_into(view)
        if not read:
            raise EOFError
        view = view[read:]
    return data


class Channel:
    """The end that never waits: what the socket does not take yet is kept, as is the beginning of a message."""

    def __init__(self, end: socket.socket) -> None:
        """Take over a socket."""
        end.setblocking(False)
        self._end = end
        self._to_send: deque[memoryview] = deque()
        self._read = bytearray()

    def fileno(self) -> int:
        """The socket's, to poll: for reading always, for writing while `is_full`."""
        return self._end.fileno()

    @property
    def is_full(self) -> bool:
        """Whether something waits to be sent; `flush` when the socket is writable."""
        return bool(self._to_send)

    def send(self, *frames: bytes) -> None:
        """Send messages made by `framed`, or begin to."""
        self._to_send.extend(map(memoryview, frames))
        self.flush()

    def flush(self) -> None:
        """Send as much as the socket takes. If that fails the connection is at an end, as `receive` tells."""
        try:
            while self._to_send:
                sent = self._end.send(self._to_send[0])
                if sent < len(self._to_send[0]):
                    self._to_send[0] = self._to_send[0][sent:]
                else:
                    self._to_send.popleft()
        except BlockingIOError:
            pass
        except OSError:  # perhaps in the middle of a message, so that nothing more can be said
            self._to_send.clear()
            with suppress(OSError):
                self._end.shutdown(socket.SHUT_RDWR)

    @property
    def is_halfway(self) -> bool:
        """Whether a message has begun to come."""
        return bool(self._read)

    def receive(self) -> tuple[list[Any], bool]:
        """(whole messages that have come, whether there may be more): no more once the other end is closed.

        Raises:
            Exception: whatever unpickling a message raises.
        """
        is_open = True
        try:
            while data := self._end.recv(_READ_BYTES):
                self._read += data
                if len(data) < _READ_BYTES:
                    break
            else:
                is_open = False
        except BlockingIOError:
            pass
        except OSError:
            is_open = False
        messages, start = [], 0
        with memoryview(self._read) as view:
            while len(view) - start >= _LENGTH.size:
                body = start + _LENGTH.size
                end = body + _LENGTH.unpack(view[start:body])[0]
                if end > len(view):
                    break
                messages.append(pickle.loads(view[body:end]))
                start = end
        del self._read[:start]
        return messages, is_open

    def close(self) -> None:
        """Free the socket."""
        self._end.close()
