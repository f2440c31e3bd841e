"""Messages over a stream socket between a driver and a worker on the same machine.

A message is eight bytes of length, followed by a pickle. The worker's end blocks. The driver's end never blocks,
whatever state the worker is in.
"""

from __future__ import annotations

import pickle
import socket
import struct
from collections import deque
from contextlib import suppress
from itertools import islice
from typing import Any

_LENGTH = struct.Struct("!Q")
_READ_BYTES = 1 << 16
BUFFER_BYTES = 1 << 20
"""Send buffer requested for each socket, so that most messages are sent at once; the system may grant less."""

FRAMES_AT_ONCE = 512
"""Number of frames in one call to the system, which takes at most 1,024."""


def framed(message: Any) -> bytes:
    """A message as the bytes that are sent: its length, then its pickle."""
    body = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
    return _LENGTH.pack(len(body)) + body


def receive(end: socket.socket) -> Any:
    """The next message from a blocking socket.

    Raises:
        EOFError: the other end has closed the connection.
        OSError: the connection failed.
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
    """The end that never blocks. It keeps bytes that the socket does not take yet and messages that are incomplete."""

    def __init__(self, end: socket.socket) -> None:
        """Take over a socket and make it non-blocking."""
        end.setblocking(False)
        self._end = end
        self._to_send: deque[memoryview] = deque()
        self._read, self._part = bytearray(), memoryview(bytearray(_READ_BYTES))

    def fileno(self) -> int:
        """File descriptor of the socket. Poll it for reading, and while `is_full` also for writing."""
        return self._end.fileno()

    @property
    def is_full(self) -> bool:
        """Whether bytes remain to be sent; call `flush` when the socket is writable."""
        return bool(self._to_send)

    def send(self, *frames: bytes) -> None:
        """Send messages made by `framed`, as far as the socket takes them now."""
        self._to_send.extend(map(memoryview, frames))
        self.flush()

    def flush(self) -> None:
        """Send as much as the socket takes now. If that fails, shut the connection down, which `receive` reports.

        All frames are sent in one call, since each call wakes the receiver, which would compete with the sender.
        """
        try:
            while self._to_send:
                sent = self._end.sendmsg(islice(self._to_send, FRAMES_AT_ONCE))
                while self._to_send and sent >= len(self._to_send[0]):
                    sent -= len(self._to_send.popleft())
                if sent:
                    self._to_send[0] = self._to_send[0][sent:]
        except BlockingIOError:
            pass
        except OSError:  # part of a message may have been sent, so no other message can follow
            self._to_send.clear()
            with suppress(OSError):
                self._end.shutdown(socket.SHUT_RDWR)

    @property
    def is_halfway(self) -> bool:
        """Whether part of a message has been received."""
        return bool(self._read)

    def receive(self) -> tuple[list[Any], bool]:
        """(complete messages received so far, whether the connection is still open).

        Raises:
            Exception: any exception that unpickling a message raises.
        """
        is_open = True
        try:
            while size := self._end.recv_into(self._part):
                self._read += self._part[:size]
                if size < _READ_BYTES:
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
        self._end.close()
