"""Everything of a run that can be read, also of a damaged one: what is sound, and a sentence about what is not.

A report needs many kinds of data of one generation at once and should show what is left of a damaged run. All other
readers (`reader`) refuse damaged data instead.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from es_service.errors import StoreError
from es_service.protocol.content import Arrays
from es_service.store.codec import row_dict
from es_service.store.facts import GENERATION, Damaged, said_by
from es_service.store.folder import COPY
from es_service.store.reader import connected_to, reading
from es_service.store.records import metric_columns, metric_values, sound_platforms, stored_metrics
from es_service.store.rows import Columns, GrowingTable, StoredRow, history_rows, newest_generation, table_rows
from es_service.store.schema import RunMeta
from es_service.store.states import kept_rows, newest_state, rows_in_force, sound_content, sound_part, whole_states

Keep = Callable[[RunMeta, str, Arrays], Arrays | None]
"""Function (the run, name of a part, its arrays) -> the arrays to keep; None: keep nothing of this part. It raises
ValueError for arrays that the run cannot have."""

NamedBy = Callable[[RunMeta, dict[str, Arrays]], Iterable[bytes]]
"""Function (the run, the parts that were kept) -> names of the contents that are wanted."""


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
    contents: dict[bytes, Arrays]
    """Contents that they name, as far as they were wanted."""
    problems: tuple[str, ...]
    """What is missing and why, one sentence each; empty if the run is sound as far as it was read."""


def read_sound(
    folder: Path,
    kept: Keep = lambda meta, part, arrays: arrays,
    named: NamedBy = lambda meta, parts: (),
) -> SoundRun:
    """Read a run as far as it is sound; see `SoundRun`. Parts are decoded one at a time, then passed to `kept`.

    Args:
        named: names of the contents that are wanted, of all parts that were kept.

    Raises:
        StoreError: neither the database nor its copy has a sound description of the run.
    """
    return Followed(folder, kept, named=named).read()[0]


class Followed:
    """A run that is read again and again; each time, what was read before is not read anew."""

    def __init__(
        self,
        folder: Path,
        kept: Keep,
        wanted: Callable[[str], bool] = lambda part: True,
        named: NamedBy = lambda meta, parts: (),
    ) -> None:
        """`kept`, `named`: as in `read_sound`; `wanted`: whether to read a part of this name at all."""
        self.folder, self._kept, self._wanted, self._named = folder, kept, wanted, named
        self._contents: dict[bytes, Arrays] = {}
        self._rows: _Rows | None = None
        self._known: dict[str, tuple[tuple[int, str], Arrays | None]] = {}

    def read(self, most: int | None = None) -> tuple[SoundRun, bool]:
        """The run as far as it is read now, and whether these are all of its rows. Raises as `read_sound`.

        Args:
            most: most new rows to be read, so that the transaction is short; None: all, and this is the last time.
        """
        problems: list[str] = []
        with _any_sound(self.folder, problems) as (connection, meta):
            if self._rows is None or not self._rows.are_of(connection, meta):
                self._rows, self._known, self._contents = _Rows(meta), {}, {}
            rows = self._rows
            platforms: list[tuple[int, dict[str, Any]]] = []
            whole = rows.read(connection, problems, most)
            with _noted(problems, "the platforms cannot be read"):
                platforms = sound_platforms(connection)
            generation, parts = None, {}
            with _noted(problems, "the state cannot be read"):
                generation, parts = self._state(connection, meta, problems)
                self._contents = self._named_by(connection, meta, parts, problems)
            # Nothing can be added to a table whose columns are in use.
            history, evaluations = (table.columns(copy=most is not None) for table in (rows.history, rows.evaluations))
            newest = None if rows.last is None else row_dict(meta.columns, rows.last.row)
            with _noted(problems, "the recorded metrics cannot be read"):
                found, damaged = stored_metrics(connection)
                history |= metric_columns(found, history["generation"])
                newest = newest and newest | metric_values(found.get(int(newest["generation"]), {}))
                if damaged:
                    which = _spans([range(at, at + 1) for at in damaged])
                    problems.append(f"the metrics recorded at generations {which} are damaged")
            return SoundRun(
                meta, history, newest, evaluations, platforms, generation, parts, self._contents, tuple(problems)
            ), whole

    def _state(
        self, connection: sqlite3.Connection, meta: RunMeta, problems: list[str]
    ) -> tuple[int | None, dict[str, Arrays]]:
        """The newest generation whose whole state is stored, and its parts; the newest parts there are if none is."""
        stored = kept_rows(connection)
        generations = (newest_state(connection), newest_generation(connection))
        if (newest := max((at for at in generations if at is not None), default=None)) is None:
            return None, {}
        whole = whole_states(connection, stored)
        generation = max(whole, default=newest)
        if newest not in whole:
            instead = f"; that of generation {generation} is shown" if whole else ""
            problems.append(f"the state of generation {newest} is incomplete{instead}")
        known, self._known, damaged = self._known, {}, []
        for part, row in rows_in_force(stored, generation).items():
            if not self._wanted(part):
                continue
            before = known.get(part)
            if before is None or before[0] != row:
                try:
                    before = row, self._kept(meta, part, sound_part(connection, part, *row))
                except (sqlite3.Error, Damaged, ValueError):
                    damaged.append(part)
                    continue
            self._known[part] = before
        if damaged:
            more = f" and {len(damaged) - 3} more" if len(damaged) > 3 else ""
            problems.append(f"the state of {', '.join(damaged[:3])}{more} is damaged")
        return generation, {part: arrays for part, (_, arrays) in self._known.items() if arrays is not None}

    def _named_by(
        self, connection: sqlite3.Connection, meta: RunMeta, parts: dict[str, Arrays], problems: list[str]
    ) -> dict[bytes, Arrays]:
        contents, damaged = {}, 0
        for name in self._named(meta, parts):
            try:
                known = self._contents.get(name)
                contents[name] = sound_content(connection, name) if known is None else known
            except (sqlite3.Error, Damaged, KeyError):
                damaged += 1
        if damaged:
            problems.append(f"{damaged} of the policies and paths that its state names are damaged or missing")
        return contents


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
        problems.append(f"{what}: {said_by(error)}")


class _Rows:
    """The sound history rows of a run, and the centres that were evaluated; a damaged row is left out."""

    def __init__(self, meta: RunMeta) -> None:
        self._meta = meta
        self.history = GrowingTable(meta.columns)
        self.evaluations = GrowingTable((GENERATION, *meta.evaluation_columns))
        self.last: StoredRow | None = None
        self._lost: list[range] = []

    @property
    def _next(self) -> int:
        """Generation of the next row to be read."""
        return 0 if self.last is None else self.last.generation + 1

    def read(self, connection: sqlite3.Connection, problems: list[str], most: int | None) -> bool:
        """Read the rows after those that are read, at most so many; return whether they are all."""
        count, first = 0, self._next
        with _noted(problems, "the end of the history cannot be read"):
            for row, is_sound in history_rows(connection, self._meta.columns, first, most):
                count += 1
                if not is_sound or row.generation < self._next:  # damage can show rows again
                    continue
                evaluated = table_rows(self._meta.evaluation_columns, row.evaluations)
                self.history.add(row.row)
                if row.generation > self._next:
                    self._lost.append(range(self._next, row.generation))
                self.last = row
                for centre in evaluated:
                    self.evaluations.add((row.generation, *centre))
        whole = count != most or self._next == first  # so many damaged rows in a row are the end
        lost = list(self._lost)
        if whole:
            with _noted(problems, "the number of generations cannot be read"):
                newest = newest_state(connection)
                if newest is not None and newest >= self._next:
                    lost.append(range(self._next, newest + 1))
        if lost:
            problems.append(f"the history rows of generations {_spans(lost)} are damaged or missing")
        return whole

    def are_of(self, connection: sqlite3.Connection, meta: RunMeta) -> bool:
        """Whether the last row is still that of the run, which may have fallen back, or be another run."""
        if meta != self._meta or self.last is None:
            return meta == self._meta
        with _noted([], ""):
            query = "SELECT sha256 FROM history WHERE generation = ?"
            return connection.execute(query, (self.last.generation,)).fetchone() == (self.last.sha256,)
        return False


def _spans(spans: list[range]) -> str:
    """Increasing numbers as text, such as "3, 7 to 9"; at most five spans."""
    shown = [str(span[0]) if len(span) == 1 else f"{span[0]} to {span[-1]}" for span in spans[:5]]
    return ", ".join(shown) + (" and others" if len(spans) > 5 else "")
