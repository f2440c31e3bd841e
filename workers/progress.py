"""How far a process is with what it computes: a row of numbers, which another thread or process reads.

Code that may take long changes the numbers of its own process, which costs it nothing that can be measured and no
message. Whoever looks at them from time to time sees whether the process still does something, so a deadline can follow
the work. A worker whose cores are child processes reads the rows of all of them.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Hashable, Iterator, MutableSequence, Sequence
from contextlib import contextmanager
from itertools import count
from typing import NamedTuple, TypeVar

Thing = TypeVar("Thing")
MOVES, DOING, DONE, TOTAL, CALL = range(5)
"""Numbers of a row: how often something was done, what is done with environments before their first step, with how many
of how many, and the call of the worker that this belongs to."""
SIZE, NUMBER_BYTES = 5, 8
DOINGS = ("", "making", "resetting")
"""Values of DOING, in words."""

Counters = MutableSequence[int] | memoryview
_own: Counters = [0] * SIZE
_rows: list[Counters] = [_own]
_numbers = count(1)
_running: dict[int, None] = {}
"""Calls that the cores of this worker compute, oldest first."""


class Seen(NamedTuple):
    """What a look at the numbers shows of the oldest call that is computed."""

    moves: Hashable
    """Differs from that of another look if something was done between the two."""
    doing: str
    done: int
    total: int


def moved() -> None:
    """Note that one more of the things was done of which the work consists, such as a step or a call."""
    _own[MOVES] += 1


def counted(doing: str, things: Sequence[Thing]) -> Iterator[Thing]:
    """The things one after another, each of which is noted when the next one is asked for.

    Args:
        doing: what is done with them, of DOINGS.
    """
    own = _own
    own[DONE], own[TOTAL], own[DOING] = 0, len(things), DOINGS.index(doing)
    try:
        for thing in things:
            yield thing
            own[DONE] += 1
            own[MOVES] += 1
    finally:
        own[DOING] = 0


def seen() -> Seen:
    """What the numbers of this worker show now."""
    call = next(iter(list(_running)), 0)
    rows = [(core, list(row)) for core, row in enumerate(_rows) if row[CALL] == call]
    doing = min((row[DOING] for _, row in rows if row[DOING]), default=0)
    of_doing = [row for _, row in rows if row[DOING] == doing]
    done, total = (sum(row[number] for row in of_doing) if doing else 0 for number in (DONE, TOTAL))
    moves = call, doing, total, tuple((core, row[MOVES]) for core, row in rows)
    return Seen(moves, DOINGS[doing], done, total)


def shared_rows(cores: int) -> str:
    """Rows for child processes, which `seen` reads from now on; the file in memory where `use_row` finds them. It stays
    as long as this process."""
    file, size = os.memfd_create("progress"), NUMBER_BYTES * SIZE * cores
    os.ftruncate(file, size)
    _rows[:] = [_row(mmap.mmap(file, size), core) for core in range(cores)]
    return f"/proc/{os.getpid()}/fd/{file}"


def use_row(file: str, core: int) -> None:
    global _own
    with open(file, "r+b") as opened:
        _own = _row(mmap.mmap(opened.fileno(), 0), core)
    _rows[:] = [_own]


def _row(memory: mmap.mmap, core: int) -> memoryview:
    return memoryview(memory).cast("q")[SIZE * core : SIZE * (core + 1)]


@contextmanager
def call() -> Iterator[int]:
    """A call whose parts child processes compute inside the block; gives its number, for `belongs_to` there."""
    number = next(_numbers)
    _running[number] = None
    try:
        yield number
    finally:
        del _running[number]


def belongs_to(call: int) -> None:
    """Note that what this process does from now on belongs to a call."""
    _own[CALL] = call
