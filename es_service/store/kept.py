"""Which states a run keeps: those of its last two generations, and those of generations that were asked for.

A row of the state is deleted when no state to which it belongs (`rows`) is to be kept. A row that removes its part is
deleted together with the last of the older rows, from which it protects the states after it.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Mapping

from es_service.store.codec import GONE, changed_sum, state_sum
from es_service.store.rows import KeptRows, rows_in_force, whole_states


class KeptStates:
    """The rows of the state that are stored, as the writer of a run follows them from commit to commit."""

    def __init__(self, connection: sqlite3.Connection, rows: KeptRows, newest: int | None) -> None:
        """`rows`: all intact rows that are stored; `newest`: newest generation, None if there is none."""
        self._rows = rows
        self.total = 0 if newest is None else state_sum(rows_in_force(rows, newest))
        """`codec.state_sum` of the newest state."""
        # Parts of which an older row is stored as well, which the generation before the newest needs.
        self._doubled = [part for part, of_part in rows.items() if len(of_part) > 1]
        # States of earlier generations that are kept now stay, whatever is kept from now on.
        self._earlier = [] if newest is None else [at for at in whole_states(connection, rows) if at < newest - 1]

    def names(self) -> list[str]:
        """Parts of the newest state."""
        return sorted(part for part, of_part in self._rows.items() if of_part[max(of_part)] != GONE)

    def newest(self, part: str) -> tuple[int, str]:
        """(generation, SHA-256) of the newest row of a part. Raises KeyError if the newest state has no such part."""
        at, sha256 = max(self._rows[part].items())
        if sha256 == GONE:
            raise KeyError(part)
        return at, sha256

    def total_after(self, new: Mapping[str, tuple[int, str]]) -> int:
        """`total` after a commit of these rows: part -> (generation, SHA-256 or GONE)."""
        old = {part: max(self._rows[part].items()) for part in new if part in self._rows}
        return changed_sum(self.total, old, new)

    def outdated(self, keep_every: int | None) -> list[tuple[str, int]]:
        """(part, generation) of the rows that the next commit deletes: the rows that remain make up the states of its
        generation, of the one before it, and of those to keep, such as multiples of `keep_every`."""
        found = []
        for part in self._doubled:
            at, until = sorted(self._rows[part])[-2:]
            is_multiple = keep_every is not None and (until - 1) // keep_every * keep_every >= at
            if not is_multiple and not any(at <= generation < until for generation in self._earlier):
                found.append((part, at))
                if self._rows[part][until] == GONE and len(self._rows[part]) == 2:
                    found.append((part, until))
        return found

    def commit(self, new: Mapping[str, tuple[int, str]], outdated: Iterable[tuple[str, int]], total: int) -> None:
        """Follow a commit, with what `total_after` and `outdated` have returned for it."""
        self.total = total
        for part, at in outdated:
            del self._rows[part][at]
            if not self._rows[part]:
                del self._rows[part]
        for part, (at, sha256) in new.items():
            self._rows.setdefault(part, {})[at] = sha256
        self._doubled = [part for part in new if len(self._rows[part]) > 1]
