"""What processes print, in files of which only the newest part is kept.

A simulator may print in each of its steps, for days, also from code that is not Python and from processes of its own.
All of them append to one file, and nobody waits for a reader, as at a pipe. A thread elsewhere looks at the file's
size, and cuts off its beginning. Its end is there after a SIGKILL, too.
"""

from __future__ import annotations

import fcntl
import os
import stat
import threading
import time
from contextlib import suppress
from functools import cache

LOOK_S = 0.02
"""Longest time in seconds between two looks at the files; less while one of them grows fast."""
SHORTEST_S = 0.001


class NewestOutput:
    """Files that are cut to half a size before they exceed it, by a thread that lives as long as there is one.

    A line that is written while a file is cut may be lost, or come before older ones.
    """

    def __init__(self) -> None:
        """Watch no file yet."""
        self._files: dict[int, tuple[int, int]] = {}
        """Descriptors of our own -> (most bytes, bytes at the last look)."""
        self._turn, self._thread, self._end = threading.Lock(), threading.Thread(), threading.Event()

    def add(self, descriptor: int, most_bytes: int) -> int:
        """Watch the file to which a descriptor leads; whoever has inherited this descriptor appends from now on.

        Returns the number for `forget`. Raises OSError if it leads to nothing that can be read and cut, such as a pipe.
        """
        flags = fcntl.fcntl(descriptor, fcntl.F_GETFL)
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError("its size cannot be changed, since it is no regular file")
        is_readable = flags & os.O_ACCMODE == os.O_RDWR
        watched = os.dup(descriptor) if is_readable else os.open(f"/proc/self/fd/{descriptor}", os.O_RDWR | os.O_APPEND)
        fcntl.fcntl(descriptor, fcntl.F_SETFL, flags | os.O_APPEND)
        with self._turn:
            if not self._files:
                self._end = threading.Event()
                self._thread = threading.Thread(target=self._run, args=(self._end,), daemon=True, name="newest output")
                self._thread.start()
            self._files[watched] = most_bytes, 0
        return watched

    def forget(self, watched: int) -> None:
        """Leave a file as it is from now on."""
        with self._turn:
            if self._files.pop(watched, None) is None:
                return
            os.close(watched)
            if self._files:
                return
            self._end.set()
            thread = self._thread
        thread.join()

    def _run(self, end: threading.Event) -> None:
        wait_s, looked_s = LOOK_S, time.monotonic()
        while not end.wait(wait_s):
            now, wait_s = time.monotonic(), LOOK_S
            with self._turn:
                if end.is_set():
                    return
                for watched, (most, before) in self._files.items():
                    size = os.fstat(watched).st_size
                    growth = (size - before) / (now - looked_s)
                    if size > 3 * most // 4:
                        with suppress(OSError):  # such as a full disk
                            size = cut(watched, most // 2)
                    self._files[watched] = most, size
                    wait_s = min(wait_s, (most - size) / 4 / max(growth, 1.0))
            looked_s, wait_s = now, max(wait_s, SHORTEST_S)


def newest_output() -> NewestOutput:
    """The files that this process watches."""
    return _of(os.getpid())


@cache
def _of(process: int) -> NewestOutput:
    """Those of a process; one that was forked has no thread that watches them."""
    return NewestOutput()


def cut(descriptor: int, most_bytes: int) -> int:
    """Take away the beginning of a file that others append to; returns how many bytes are left."""
    newest = os.pread(descriptor, most_bytes, max(0, os.fstat(descriptor).st_size - most_bytes))
    os.ftruncate(descriptor, 0)
    os.write(descriptor, newest)
    return len(newest)
