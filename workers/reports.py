"""What a worker tells besides results: what its process prints, and that it should be replaced by a new process.

A simulator prints to the descriptors 1 and 2, also in C and from processes of its own. Those lead to files, of which
the newest part is stored (`es_service/protocol/process_environment.py`); the worker reads there what is new.
"""

from __future__ import annotations

import os
import re
import stat
import threading
import time
from collections.abc import Iterable
from contextlib import suppress

from es_service.protocol.errors import TaskError
from es_service.protocol.machine import memory_of_tree_bytes
from es_service.protocol.messages import ChunkResult, EpisodesResult, Report, WorkerSpec

PRINTED_BYTES = 2000
"""At most this many bytes of what is new are told at a time: the newest."""
CONTROL_SEQUENCE = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]")
"""What colours the text of a terminal, among other things."""
LINE_END = re.compile(rb"[\r\n]")
LOOK_S = 0.5
"""Seconds between two looks at the memory."""


class Tail:
    """The end of a file to which this process and others append, and whose beginning may be cut off."""

    def __init__(self, descriptor: int) -> None:
        """Begin at the end of the file to which a descriptor leads. If it leads to none, there is nothing to read."""
        self._file, self._at = -1, 0
        with suppress(OSError):
            if stat.S_ISREG(os.fstat(descriptor).st_mode):
                self._file = os.open(f"/proc/self/fd/{descriptor}", os.O_RDONLY | os.O_CLOEXEC)
                self._at = os.fstat(self._file).st_size

    @property
    def file(self) -> tuple[int, int]:
        status = os.fstat(self._file)
        return status.st_dev, status.st_ino

    @property
    def is_readable(self) -> bool:
        """Whether there is a file."""
        return self._file >= 0

    def new(self, most_bytes: int = PRINTED_BYTES) -> str:
        """What was written since the last call, the newest part of it: printable lines. If there is more, it begins
        with the first whole line, if there is one."""
        if self._file < 0:
            return ""
        size = os.fstat(self._file).st_size
        known = self._at if self._at <= size else 0  # a smaller file was cut
        first = max(known, size - most_bytes)
        self._at = size
        if first == known:
            return printable(os.pread(self._file, size - first, first))
        with_end_before = os.pread(self._file, size - first + 1, first - 1)
        end = LINE_END.search(with_end_before, 0, len(with_end_before) - 1)
        return printable(with_end_before[end.end() if end else 1 :])

    def skip(self) -> None:
        """Leave out what was written until now."""
        if self._file >= 0:
            self._at = os.fstat(self._file).st_size

    def close(self) -> None:
        """Read nothing any more."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def printable(printed: bytes) -> str:
    """The lines of what was printed, without characters that would change how a terminal shows others."""
    text = CONTROL_SEQUENCE.sub("", printed.decode(errors="replace"))
    lines = text.replace("\r", "\n").split("\n")
    clean = ("".join(mark for mark in line.expandtabs() if mark.isprintable()).rstrip() for line in lines)
    return "\n".join(line for line in clean if line)


class Reports:
    """The reports of a worker. They may be asked for in several threads."""

    def __init__(self, spec: WorkerSpec, cores: int = 1, episodes: int = 0) -> None:
        """Begin before the worker has computed anything for a run.

        Args:
            episodes: that it has computed for others.
            cores: of the worker, each of which may have as many episodes and as much memory.
        """
        tails = [tail for tail in map(Tail, (1, 2)) if tail.is_readable]
        self._tails = list({tail.file: tail for tail in tails}.values())
        self._most_episodes = None if spec.recycle_after_episodes is None else cores * spec.recycle_after_episodes
        self._of_member = spec.episodes_per_member
        self._most_bytes, self._cores = _limit(spec, cores), cores
        self._turn, self.episodes, self._looked_s, self._is_told = threading.Lock(), episodes, time.monotonic(), False

    def close(self) -> None:
        """Report nothing any more that was printed."""
        with self._turn:
            for tail in self._tails:
                tail.close()

    def note(self, results: Iterable[ChunkResult]) -> None:
        of_member = self._of_member  # a training chunk, which alone has moments, counts members
        episodes = sum(
            result.steps.size * (of_member if result.moments is not None else 1)
            for result in results
            if isinstance(result, EpisodesResult)
        )
        with self._turn:
            self.episodes += episodes

    def report(self) -> Report | None:
        """What is new since the last report; None if nothing is."""
        with self._turn:
            printed = "\n".join(filter(None, (tail.new() for tail in self._tails)))
            spent = "" if self._is_told else self._spent()
            self._is_told |= bool(spent)
        return Report(printed, spent) if printed or spent else None

    def _spent(self) -> str:
        """Why the worker should be replaced; empty if it should not."""
        after = f"{self.episodes:,} episodes"
        if self._most_episodes is not None and self.episodes >= self._most_episodes:
            return f"it has computed {after} (task.recycle_after_episodes)"
        if self._most_bytes and (now_s := time.monotonic()) >= self._looked_s + LOOK_S:
            self._looked_s = now_s
            if (has := memory_of_tree_bytes()) > self._most_bytes:
                of = "" if self._cores == 1 else f" on {self._cores} cores"
                return f"it has {has / 2**20:,.0f} MiB of memory{of} after {after} (compute.worker_memory_mb)"
        return ""


def reports_of(spec: WorkerSpec, cores: int = 1, before: Reports | None = None) -> Reports:
    """The reports of a worker for a run: what is printed from now on; and what its process has computed for the run
    before counts, too, since it has leaked."""
    if before is not None:
        before.close()
    return Reports(spec, cores, 0 if before is None else before.episodes)


def require_room(spec: WorkerSpec, cores: int = 1) -> None:
    """Raise TaskError if a worker that has computed nothing yet already has more memory than it may have."""
    has, most = memory_of_tree_bytes() if spec.memory_bytes else 0, _limit(spec, cores)
    if has > most:
        raise TaskError(
            f"compute.worker_memory_mb = {most // cores // 2**20} is too little: before its first episode, a worker "
            f"has {has / cores / 2**20:,.0f} MiB"
        )


def _limit(spec: WorkerSpec, cores: int) -> int:
    """Most bytes of all cores; 0 if there is no limit."""
    return cores * (spec.memory_bytes or 0)
