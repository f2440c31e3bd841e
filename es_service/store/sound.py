"""Everything of a run that can be read, also of a damaged one: what is sound, and a sentence about what is not.

A report needs many kinds of data of one generation at once and should show what is left of a damaged run. All other
readers (`reader`) refuse damaged data instead.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from es_service.errors import StoreError
from es_service.store.codec import Row, column_bytes, decode_part, part_sha256, row_dict
from es_service.store.columns import Columns, Table
from es_service.store.connection import connected_to, reading
from es_service.store.folder import COPY
from es_service.store.kept import kept_rows, newest_state, rows_in_force, whole_states
from es_service.store.reader import GENERATION, platforms, state_payload
from es_service.store.schema import Damaged, RunMeta, history_select
from es_service.store.tables import table_rows
from es_service.store.verify import row_is_sound

Arrays = dict[str, NDArray[Any]]
Kept = Callable[[str, Arrays], Arrays | None]
"""Function (name of a part, its arrays) -> the arrays to keep; None: keep nothing of this part."""


@dataclass(frozen=True)
class SoundRun:
    """What could be read of a run in one transaction; every value matches its SHA-256."""

    meta: RunMeta
    history: Columns
    """Sound history rows in the order of generations."""
    newest: dict[str, int | float] | None
    """The last of these rows, as values by column name; NaN stands for no value. None if there is none."""
    evaluations: Columns
    """The centres that these generations evaluated, in the order of the asks; the first column is `generation`."""
    platforms: list[tuple[int, dict[str, Any]]]
    """(first generation, platform); each applies until the next one."""
    generation: int | None
    """Generation of `parts`; None if no state is stored."""
    parts: dict[str, Arrays]
    problems: tuple[str, ...]
    """What is missing and why, one sentence each; empty if the run is sound as far as it was read."""


def read_sound(folder: Path, kept: Kept = lambda part, arrays: arrays) -> SoundRun:
    """Read a run as far as it is sound; see `SoundRun`. Parts are decoded one at a time, then passed to `kept`.

    Raises:
        StoreError: neither the database nor its copy has a sound description of the run.
    """
    problems: list[str] = []
    with _any_sound(folder, problems) as (connection, meta):
        rows = Rows(meta)
        rows.read(connection, problems)
        return _sound_run(connection, rows, kept, problems)


class Followed:
    """A run that is read again and again; each time, what was read before is not read anew."""

    def __init__(self, folder: Path, kept: Kept, wanted: Callable[[str], bool]) -> None:
        """`kept`: as in `read_sound`; `wanted`: whether to read a part of this name at all."""
        self.folder, self._kept, self._wanted = folder, kept, wanted
        self._rows: Rows | None = None
        self._known: dict[str, tuple[int, str, Arrays | None]] = {}

    def read(self, most: int) -> tuple[SoundRun, bool]:
        """The run as far as it is read now, with at most so many new rows, so that the transaction is short; and
        whether these are all. Raises StoreError as `read_sound`."""
        problems: list[str] = []
        with _any_sound(self.folder, problems) as (connection, meta):
            if self._rows is None or not self._rows.are_of(connection, meta):
                self._rows, self._known = Rows(meta), {}
            whole = self._rows.read(connection, problems, most)
            found = _sound_run(connection, self._rows, self._kept, problems, self._wanted, self._known)
            history, evaluations = (  # copies, since nothing can be added to a table whose columns are in use
                {name: values.copy() for name, values in columns.items()}
                for columns in (found.history, found.evaluations)
            )
            return replace(found, history=history, evaluations=evaluations), whole


def _sound_run(
    connection: sqlite3.Connection,
    rows: Rows,
    kept: Kept,
    problems: list[str],
    wanted: Callable[[str], bool] = lambda part: True,
    known: dict[str, tuple[int, str, Arrays | None]] | None = None,
) -> SoundRun:
    """The run of a connection whose rows are read already; see `_state` for `wanted` and `known`."""
    found: list[tuple[int, dict[str, Any]]] = []
    with _noted(problems, "the platforms cannot be read"):
        found = platforms(connection)
    generation, parts = None, {}
    with _noted(problems, "the state cannot be read"):
        generation, parts = _state(connection, kept, problems, wanted, {} if known is None else known)
    return SoundRun(
        rows.meta, rows.history.columns(), rows.newest, rows.evaluations.columns(), found, generation, parts,
        tuple(problems),
    )  # fmt: skip


@contextlib.contextmanager
def _any_sound(folder: Path, problems: list[str]) -> Iterator[tuple[sqlite3.Connection, RunMeta]]:
    """Connection to the run, or to its copy if the database cannot be opened."""
    with contextlib.ExitStack() as stack:
        try:
            opened = stack.enter_context(reading(folder))
        except StoreError as error:
            if not (folder / COPY).exists():
                raise
            try:
                opened = connected_to(folder / COPY)
            except (sqlite3.Error, Damaged, UnicodeDecodeError):
                raise error from None
            stack.enter_context(contextlib.closing(opened[0]))
            problems.append(f"{error.sentence}; shown is its copy {COPY}")
        yield opened


@contextlib.contextmanager
def _noted(problems: list[str], what: str) -> Iterator[None]:
    """Context manager that turns damage into a sentence."""
    try:
        yield
    except (sqlite3.Error, Damaged, ValueError, TypeError, KeyError) as error:
        problems.append(f"{what}: {error}")


class Rows:
    """The sound history rows of a run, and the centres that were evaluated; a damaged row is left out."""

    def __init__(self, meta: RunMeta) -> None:
        self.meta = meta
        self.history, self.evaluations = Table(meta.columns), Table((GENERATION, *meta.evaluation_columns))
        self.sha256: object = None
        """That of the last sound row."""
        self.last: Row | None = None
        self.next = 0
        """Generation of the next row to be read."""
        self._lost: list[range] = []

    @property
    def newest(self) -> dict[str, int | float] | None:
        """The last of the rows, as values by column name."""
        return None if self.last is None else row_dict(self.meta.columns, self.last)

    def read(self, connection: sqlite3.Connection, problems: list[str], most: int = -1) -> bool:
        """Read the rows after those that are read, at most so many (-1: all); return whether they are all."""
        columns, at = column_bytes(self.meta.columns), [one.name for one in self.meta.columns].index("generation")
        count, first = 0, self.next
        with _noted(problems, "the end of the history cannot be read"):
            query = history_select(self.meta.columns) + " WHERE history.generation >= ? ORDER BY history.generation"
            for *values, centres, state, sha256 in connection.execute(f"{query} LIMIT ?", (self.next, most)):
                row, count = tuple(values), count + 1
                # A damaged page can also show rows again.
                if not row_is_sound(columns, row, centres, state, sha256) or row[at] < self.next:
                    continue
                evaluated = table_rows(self.meta.evaluation_columns, centres)
                self.history.add(row)
                if row[at] > self.next:
                    self._lost.append(range(self.next, row[at]))
                self.last, self.sha256, self.next = row, sha256, row[at] + 1
                for centre in evaluated:
                    self.evaluations.add((row[at], *centre))
        whole = count != most or self.next == first  # so many damaged rows in a row are the end
        lost = list(self._lost)
        if whole:
            with _noted(problems, "the number of generations cannot be read"):
                newest = newest_state(connection)
                if newest is not None and newest >= self.next:
                    lost.append(range(self.next, newest + 1))
        if lost:
            problems.append(f"the history rows of generations {_spans(lost)} are damaged or missing")
        return whole

    def are_of(self, connection: sqlite3.Connection, meta: RunMeta) -> bool:
        """Whether the last row is still that of the run, which may have fallen back, or be another one."""
        if meta != self.meta or self.next == 0:
            return meta == self.meta
        with _noted([], ""):
            query = "SELECT sha256 FROM history WHERE generation = ?"
            return connection.execute(query, (self.next - 1,)).fetchone() == (self.sha256,)
        return False


def _state(
    connection: sqlite3.Connection,
    kept: Kept,
    problems: list[str],
    wanted: Callable[[str], bool],
    known: dict[str, tuple[int, str, Arrays | None]],
) -> tuple[int | None, dict[str, Arrays]]:
    """The newest generation whose whole state is stored, and its parts; the newest parts there are if none is.

    Args:
        wanted: whether to read a part of this name at all.
        known: the parts of an earlier call, which are not read again, and are replaced by those of this one.
    """
    stored = kept_rows(connection)
    found = (newest_state(connection), connection.execute("SELECT max(generation) FROM history").fetchone()[0])
    if (newest := max((at for at in found if at is not None), default=None)) is None:
        return None, {}
    whole = whole_states(connection, stored)
    generation = max(whole, default=newest)
    if newest not in whole:
        problems.append(
            f"the state of generation {newest} is incomplete"
            + (f"; that of generation {generation} is shown" if whole else "")
        )
    parts: dict[str, Arrays] = {}
    damaged = []
    before = dict(known)
    known.clear()
    for part, (at, sha256) in sorted(rows_in_force(stored, generation).items()):
        if not wanted(part):
            continue
        at_before, sha256_before, arrays = before.get(part, (None, None, None))
        if (at, sha256) != (at_before, sha256_before):
            try:
                payload = state_payload(connection, part, at)
                if part_sha256(part, at, payload) != sha256:
                    raise ValueError(part)
                arrays = kept(part, decode_part(payload))
            except (sqlite3.Error, Damaged, ValueError):
                damaged.append(part)
                continue
        known[part] = at, sha256, arrays
        if arrays is not None:
            parts[part] = arrays
    if damaged:
        more = f" and {len(damaged) - 3} more" if len(damaged) > 3 else ""
        problems.append(f"the state of {', '.join(damaged[:3])}{more} is damaged")
    return generation, parts


def _spans(spans: list[range]) -> str:
    """Increasing numbers as text, such as "3, 7 to 9"; at most five spans."""
    shown = [str(span[0]) if len(span) == 1 else f"{span[0]} to {span[-1]}" for span in spans[:5]]
    return ", ".join(shown) + (" and others" if len(spans) > 5 else "")
