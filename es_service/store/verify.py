"""Verification of a run's database: SQLite's own check, the tables, and every SHA-256."""

from __future__ import annotations

import sqlite3
from collections.abc import Set
from dataclasses import dataclass
from pathlib import Path

from es_service.protocol.content import names_in
from es_service.store.codec import NO_PAYLOAD, decode_part, listed, part_sha256
from es_service.store.facts import Damaged, said_by
from es_service.store.folder import is_no_damage
from es_service.store.records import CertifiedKey, certified_rows, load_start, row_name, sound_platforms, stored_metrics
from es_service.store.rows import history_rows
from es_service.store.schema import RunMeta, load_meta
from es_service.store.states import KeptRows, NamesByRow, content_of, whole_states

MOST_NAMED = 8
"""Most problems that a message names."""


@dataclass(frozen=True)
class Verdict:
    """Result of the verification of a database that can be read."""

    meta: RunMeta
    newest: int | None
    """Newest generation with a history row; None if there is none."""
    good: int | None
    """Newest generation whose whole state is intact, and the history up to it as well; None if there is none."""
    kept: KeptRows
    """Intact state rows, whose contents are intact, too."""
    named: NamesByRow
    """Names of contents in these rows and in those of certified policies, where there are any."""
    bad_rows: tuple[tuple[str, int], ...]
    """Damaged state rows as (part, generation), which must be deleted."""
    bad_certifications: tuple[CertifiedKey, ...]
    """Damaged rows of the table of certified policies, which must be emptied."""
    problems: tuple[str, ...]
    """All problems found, as messages for the user."""

    @property
    def damage(self) -> str:
        """The problems in one message, which names the first few if there are many."""
        more = [f"and {len(self.problems) - MOST_NAMED} more problems"] if len(self.problems) > MOST_NAMED else []
        return "; ".join([*self.problems[:MOST_NAMED], *more])


def verify(connection: sqlite3.Connection, file: Path, known: int = 0) -> Verdict:
    """Check everything in the database `file`; this reads all of it once.

    Args:
        known: number of history rows, from generation 0 on, that are known to be intact. They are not checked again,
            except the last two.

    Raises:
        Damaged: the whole file is unusable.
        sqlite3.Error: the check is not possible (the file is locked, no permission).
        StoreError: the schema version is another one.
    """
    try:
        return _verify(connection, file, max(0, known - 2))
    except sqlite3.Error as error:
        if is_no_damage(error, file.parent):
            raise
        raise Damaged(f"SQLite reports: {said_by(error)}") from error
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise Damaged(f"it contains values that es-service never writes: {error}") from error


def _verify(connection: sqlite3.Connection, file: Path, first: int) -> Verdict:
    # This must come first: in a newer schema version, only this table is known.
    meta = load_meta(connection, file)
    complaints = [row[0] for row in connection.execute("PRAGMA quick_check(3)")]
    if complaints != ["ok"]:
        raise Damaged(f"SQLite's quick_check reports: {'; '.join(complaints)}")
    sound_platforms(connection)
    load_start(connection)
    if connection.execute("SELECT min(generation) < 0 FROM history").fetchone()[0]:
        raise Damaged("it has a history row of a negative generation")

    problems: list[str] = []
    count, sound = _history(connection, meta, first, problems)
    contents = _contents(connection, problems)
    kept, named, bad_rows = _state(connection, contents, problems)
    bad_certified: list[CertifiedKey] = []
    for key, row in certified_rows(connection):
        names = frozenset[bytes]() if row is None else names_in(row.arrays)
        if row is None or not names <= contents:
            bad_certified.append(key)
        elif names:
            named[row_name(*key)] = names
    unnamed = contents.difference(*named.values())
    problems += [f"the content {name.hex()} is named by nothing" for name in sorted(unnamed)]
    newest = count - 1 if count else None
    unfinished = sorted((part, at) for part, rows in kept.items() for at in rows if at >= count)
    problems += [f"state of {part!r} at generation {at} has no history row" for part, at in unfinished]
    good = max((at for at in whole_states(connection, kept) if at < sound), default=None)
    if newest is not None and good != newest:
        lost = 0 if good is None else good + 1
        which = f"generation {newest} is" if lost == newest else f"generations {lost} to {newest} are"
        problems.append(f"{which} not complete and intact")
    problems += [f"row {rank} of certification {number} is damaged" for number, rank in bad_certified]
    damaged = stored_metrics(connection)[1]
    problems += [f"the metrics recorded at generation {at} are damaged" for at in damaged]
    return Verdict(meta, newest, good, kept, named, tuple(bad_rows), tuple(bad_certified), tuple(problems))


def _history(connection: sqlite3.Connection, meta: RunMeta, first: int, problems: list[str]) -> tuple[int, int]:
    """The number of history rows, and the number of those before the first damaged one. The rows of generations before
    `first` are taken for sound."""
    count, bad = first, []
    for row, is_sound in history_rows(connection, meta.columns, first):
        is_there = row.generation == count
        if not (is_there and is_sound):
            bad.append(count)
            what = "does not match its SHA-256" if is_there else "is missing"
            problems.append(f"history row of generation {count} {what}")
        count += 1
        if not is_there:
            break
    return count, min([*bad, count])


def _contents(connection: sqlite3.Connection, problems: list[str]) -> set[bytes]:
    """Names of the intact contents. SQLite's quick_check does not look at the index, by which they are found."""
    sound: set[bytes] = set()
    by_index = {*connection.execute("SELECT name, rowid FROM content INDEXED BY sqlite_autoindex_content_1")}
    stored = set()
    for name, row, payload in connection.execute("SELECT name, rowid, payload FROM content NOT INDEXED"):
        stored.add((name, row))
        if content_of(name, payload) is not None:
            sound.add(name)
        else:
            shown = name.hex() if isinstance(name, bytes) else repr(name)
            problems.append(f"the content {shown} does not match its name")
    if by_index != stored:
        problems.append("the index of the contents does not match them")
    return sound


def _state(
    connection: sqlite3.Connection, contents: Set[bytes], problems: list[str]
) -> tuple[KeptRows, dict[tuple[str, int], frozenset[bytes]], list[tuple[str, int]]]:
    """Intact state rows, what they name, and (part, generation) of the damaged ones.

    Args:
        contents: names of the intact contents.
    """
    kept: KeptRows = {}
    named: dict[tuple[str, int], frozenset[bytes]] = {}
    bad_rows: list[tuple[str, int]] = []
    for part, generation, sha256, payload in connection.execute("SELECT part, generation, sha256, payload FROM state"):
        names = frozenset[bytes]()
        try:
            sound = part_sha256(part, generation, payload) == sha256
            if sound and payload != NO_PAYLOAD:
                names = names_in(decode_part(payload))
        except (ValueError, TypeError):
            sound = False
        if sound and names <= contents:
            kept.setdefault(part, {})[generation] = listed(sha256, payload)
            if names:
                named[part, generation] = names
        else:
            what = "names a content that is missing or damaged" if sound else "does not match its SHA-256"
            problems.append(f"state of {part!r} at generation {generation} {what}")
            bad_rows.append((part, generation))
    return kept, named, bad_rows
