"""Creation of a run folder, which appears complete or not at all, even if the process is killed.

A fork begins with the history and the state of its parent. A run that starts from the centre of another run stores this
centre, so later changes of the other run have no effect on it.
"""

from __future__ import annotations

import base64
import contextlib
import os
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from es_service.errors import StoreError, WayOut
from es_service.loop.history import Row
from es_service.store.codec import (
    Part,
    encode_changes,
    encode_part,
    row_bytes,
    rows_listed,
    state_sha256,
    state_sum,
    stored_values,
)
from es_service.store.folder import (
    CONFIG,
    COPY,
    DATABASE,
    LOCK,
    explained,
    is_disk_full,
    remove_database,
    sync_file,
    write_config,
)
from es_service.store.lock import RunLock, acquire_lock
from es_service.store.records import START, metric_values, record_metrics, record_platform
from es_service.store.repair import connect
from es_service.store.rows import insert_history, row_of_history
from es_service.store.schema import RunMeta, create_tables, put_meta
from es_service.store.states import insert_contents, insert_state

SEVERAL = "centre_K_D"
"""Array of a start from several policies, instead of "centre_D"; "mean_K_O" and "std_K_O" are their statistics."""
_NEW_DATABASE = "run.db.new"
_LEFT_BEHIND = {LOCK, CONFIG, f"{CONFIG}.new", _NEW_DATABASE, f"{_NEW_DATABASE}-journal"}
"""Files that a killed creation in an existing folder may leave, which the next creation may overwrite."""


@dataclass(frozen=True)
class Beginning:
    """Data with which a run begins; empty for an ordinary run."""

    history: Iterable[Row] = ()
    """History rows of a fork's parent, of generations 0 to `newest`. They are iterated over once and need not fit into
    memory. Columns that this run does not have are left out; columns that the parent does not have get no value."""
    parts: Mapping[str, Part] = field(default_factory=dict)
    """State of the parent at generation `newest`."""
    contents: Mapping[bytes, Part] = field(default_factory=dict)
    """Policies and traces that this state names."""
    platforms: Sequence[tuple[int, dict[str, Any]]] = ()
    """(first generation, platform) of the parent, up to generation `newest`."""
    start: Part | None = None
    """Arrays from which generation 0 starts; `RunStore.start` returns them."""
    newest: int = -1
    """Last generation that is taken from the parent; -1 if there is none."""
    metrics: Mapping[int, Mapping[str, float]] = field(default_factory=dict)
    """Metrics that were recorded in the parent, by generation and by name; a column of this run replaces its own."""
    evaluations: Iterable[Sequence[Row]] = ()
    """The centres that each of these generations evaluated, likewise; none if it ends early."""


def store_beginning(connection: sqlite3.Connection, meta: RunMeta, beginning: Beginning) -> None:
    """Write the data with which a run begins into its new database, in one transaction."""
    with connection:
        connection.execute("BEGIN IMMEDIATE")
        in_force: dict[str, tuple[int, str]] = {}
        for part, arrays in beginning.parts.items():
            rows = encode_changes(beginning.newest, {part: arrays})
            insert_state(connection, rows)
            in_force |= rows_listed(rows)
        insert_contents(connection, beginning.contents.items())
        evaluations = iter(beginning.evaluations)
        for generation, given in enumerate(beginning.history):
            recorded = metric_values(beginning.metrics.get(generation, {}))  # what a program has recorded is no column
            values = {
                column.name: None if column.name in recorded else given.get(column.name) for column in meta.columns
            }
            evaluated = [row_bytes(stored_values(meta.evaluation_columns, row)) for row in next(evaluations, ())]
            # The state of the newest generation is stored, but not those of the generations before it.
            state = state_sha256(state_sum(in_force if generation == beginning.newest else {}))
            insert_history(connection, [row_of_history(meta, generation, values, b"".join(evaluated), state)])
        for generation, platform in beginning.platforms:
            record_platform(connection, generation, platform)
        columns = {column.name for column in meta.columns}
        for generation, named in beginning.metrics.items():
            new = {name: value for name, value in named.items() if columns.isdisjoint(metric_values({name: value}))}
            if new:
                record_metrics(connection, generation, new)
        if beginning.start is not None:
            put_meta(connection, START, base64.b64encode(encode_part(beginning.start)).decode())


def create_run_folder(folder: Path, config_yaml: str, meta: RunMeta, beginning: Beginning) -> RunLock:
    """Create the folder of a new run and take its lock.

    The folder is built beside its final path and then renamed. In an existing empty folder, `run.db` is renamed last.

    Raises:
        StoreError: the folder is not empty or cannot be written.
    """
    try:
        refuse_taken(folder)
        # An existing folder may be a mount point or the current folder of a process, which a rename must not replace.
        beside = not folder.is_dir()
        place = folder.absolute().parent / f".{folder.name}.creating" if beside else folder
        _make_folder(place, folder)
        lock = acquire_lock(place)
        try:
            refuse_taken(folder)  # another process may have created a run here before this one got the lock
            _build(place, config_yaml, meta, beginning)
            if beside:
                _move(place, folder)
        except BaseException:
            # The same command can then be repeated. A complete run is kept.
            if beside or not (place / DATABASE).exists():
                _remove(place, whole=beside)
            lock.release()
            raise
    except (sqlite3.Error, OSError) as error:
        raise explained(error, folder, "creating the run", "try again") from error
    return lock


def _make_folder(place: Path, folder: Path) -> None:
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if is_disk_full(error, folder.absolute().parent):
            raise
        raise StoreError(
            f"cannot create {folder}: {error.strerror} in {folder.absolute().parent}; make that folder writable or "
            "choose another folder"
        ) from error


def _build(place: Path, config_yaml: str, meta: RunMeta, beginning: Beginning) -> None:
    new = place / _NEW_DATABASE
    remove_database(new)
    remove_database(place / DATABASE)
    write_config(place, config_yaml)
    with closing(connect(new)) as connection:
        create_tables(connection, meta)
        store_beginning(connection, meta, beginning)
    os.replace(new, place / DATABASE)
    sync_file(place)


def _move(place: Path, folder: Path) -> None:
    try:
        # A rename replaces an empty folder, and fails for any other.
        os.rename(place, folder)
    except OSError as error:
        if folder.exists():
            text = f"another program created {folder} while this run was being created; choose another folder"
            raise StoreError(text) from error
        raise
    sync_file(folder.absolute().parent)


def remove_run_folder(folder: Path, *, whole: bool) -> None:
    """Delete the files of a run that could not begin, and with `whole` also its folder, unless that has other files.

    Raises:
        RunLockedError: another process writes the run.
    """
    lock = acquire_lock(folder)
    _remove(folder, whole=whole)  # what remains is a run without a generation, which can be resumed
    lock.release()


def _remove(folder: Path, *, whole: bool) -> None:
    with contextlib.suppress(OSError):
        for name in (_NEW_DATABASE, DATABASE, COPY):
            remove_database(folder / name)
        for name in (CONFIG, f"{CONFIG}.new", LOCK):
            (folder / name).unlink(missing_ok=True)
        if whole:
            folder.rmdir()


def refuse_taken(folder: Path) -> None:
    """Raise StoreError if a run cannot be created in a folder, since there is something."""
    if not folder.exists():
        return
    if not folder.is_dir():
        raise StoreError(f"cannot create a run in {folder}: it is a file; choose another folder")
    names = {path.name for path in folder.iterdir()}
    if names & {DATABASE, COPY}:
        way_out = WayOut("resume", "continue it", str(folder))
        raise StoreError(f"{folder} already holds a run", run=folder, ways_out=[way_out])
    others = sorted(names - _LEFT_BEHIND)
    if others:
        shown = ", ".join(others[:3]) + (", ..." if len(others) > 3 else "")
        raise StoreError(f"{folder} is not empty and holds no run ({shown}); choose another folder")
