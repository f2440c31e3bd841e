"""Forged runs, drawn from a seed: contents that es-service never writes, with all the SHA-256s that belong to them.

Damage (`mutations.py`) is what happens to files. A forgery is what somebody writes who knows the format.
"""

from __future__ import annotations

import hashlib
import json
import random
import sqlite3
import struct
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from es_service.loop.history import Column
from es_service.store.codec import (
    changed_sum,
    column_bytes,
    decode_part,
    encode_part,
    part_sha256,
    row_sha256,
    state_sha256,
    text_sha256,
)
from es_service.store.schema import quoted
from tests.database import database

ELSEWHERE = ("../../../victim/*", "' OR 1=1 --", "<img src=x>", "\x1b[2J", "{0}", "%s", "a" * 100_000)
SCALARS = (None, True, False, 0, -1, 7, 2**62, 10**30, 0.5, float("nan"), float("inf"), "", "text", "é\0", "\udc80")
DEEP = "[" * 100_000
"""Text that a recursive parser cannot read."""
NUMBERS = (0.0, -1.0, 0.5, 1e300, float("nan"), float("inf"), -float("inf"), 2.0**62)
SHAPES = ([1.5], ["3"], [-1], [2**62], [0, 2**70], [None], [True], [[1]], [0] * 100, 3, {}, [10**6, 10**6, 10**6])
TYPES = ("<f4", ">f8", "|b1", "<i2", "<c16", "|O", "|S3", "<U2", "(1000,)f4", "V8", "M8[s]", None, 3, ["<f4"], "x")


@np.errstate(invalid="ignore", over="ignore")
def forge(folder: Path, rng: random.Random) -> str:
    """Forge something in a run folder; returns what."""
    kinds = {
        _record: 6,
        _arrays: 8,
        _names: 2,
        _history: 4,
        _evaluated: 2,
        _schema: 1,
        _certified: 3,
        _lock: 1,
        _yaml: 1,
    }
    (kind,) = rng.choices(tuple(kinds), tuple(kinds.values()))
    return kind(folder, rng)


def any_json(rng: random.Random, instead_of: Any) -> Any:
    """A value that JSON can represent, often of the type of another one."""
    kind = rng.choice(("scalar", "scalar", "text", "list", "mapping", "like", "like"))
    match kind:
        case "scalar":
            return rng.choice(SCALARS)
        case "text":
            return rng.choice(ELSEWHERE)
        case "list":
            return rng.choice(([], [[]], [None], [1.5], ["text"], [[1, 2]], list(range(50)), [[[[[]]]]] * 3))
        case "mapping":
            return rng.choice(({}, {"": None}, {"a": {"b": []}}))
    match instead_of:
        case bool():
            return not instead_of
        case int() | float():
            return rng.choice((-instead_of, instead_of + 1, 1000 * instead_of, 0))
        case str():
            return rng.choice((instead_of[::-1], instead_of.upper(), instead_of + "\n", instead_of[:1]))
        case list():
            return rng.choice((instead_of * 2, instead_of[:1], [instead_of], instead_of[::-1]))
        case dict():
            return dict([*instead_of.items()][:-1])
    return 3


def change_json(value: Any, rng: random.Random) -> Any:
    """The value with a change at a random place."""
    inside = isinstance(value, dict | list) and len(value) > 0 and rng.random() < 0.85
    if not inside:
        return any_json(rng, value)
    key = rng.choice([*value] if isinstance(value, dict) else range(len(value)))
    changed = dict(value) if isinstance(value, dict) else list(value)
    kind = rng.random()
    if kind < 0.12:
        del changed[key]
    elif kind < 0.17 and isinstance(changed, dict):
        changed[rng.choice(("more", "", key + "x"))] = changed.pop(key)
    else:
        changed[key] = change_json(value[key], rng)
    return changed


def _text(text: str, rng: random.Random) -> str:
    """A forged JSON text."""
    if rng.random() < 0.08:
        return rng.choice((DEEP, "", "{", DEEP[:900] + "]" * 900, '{"a":' * 500 + "1" + "}" * 500, "9" * 5000, "NaN"))
    return json.dumps(change_json(json.loads(text), rng))


def _record(folder: Path, rng: random.Random) -> str:
    """A record about the run or about its platforms."""
    with database(folder / "run.db") as connection:
        key = rng.choice(("run",) * 5 + ("platforms", "schema_version", "platform"))
        if key == "platform":
            at, text = connection.execute("SELECT generation, platform FROM platform").fetchone()
            text = _text(text, rng)
            at = rng.choice((at, at, -1, 2))
            row = at, text, text_sha256(f"platform {at}", text)
            connection.execute("UPDATE platform SET generation = ?, platform = ?, sha256 = ?", row)
        else:
            (text,) = connection.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone() or ("[0]",)
            text = _text(text, rng)
            connection.execute("INSERT OR REPLACE INTO meta VALUES (?, ?, ?)", (key, text, text_sha256(key, text)))
        rehash(connection)
    return f"record {key}"


def _arrays(folder: Path, rng: random.Random) -> str:
    """The content of a part of the state."""
    with database(folder / "run.db") as connection:
        rows = connection.execute("SELECT part, generation, payload FROM state WHERE payload != x''").fetchall()
        rows = [row for row in rows if decode_part(row[2])]
        kinds = sorted({row[0].rstrip("0123456789") for row in rows})
        kind = rng.choice(kinds)
        part, at, payload = rng.choice([row for row in rows if row[0].startswith(kind)])
        payload, what = _payload(payload, rng)
        row = payload, part_sha256(part, at, payload), part, at
        connection.execute("UPDATE state SET payload = ?, sha256 = ? WHERE part = ? AND generation = ?", row)
        rehash(connection)
    return f"{what} in {part} of {at}"


def _payload(payload: bytes, rng: random.Random) -> tuple[bytes, str]:
    """A forged payload of arrays, and what is forged."""
    arrays = decode_part(payload)
    name = rng.choice(sorted(arrays))
    kind = rng.choice(("values", "values", "one value", "type", "shape", "missing", "renamed", "header", "header"))
    if arrays[name].dtype.kind == "V" and kind in ("values", "one value", "type"):  # names of policies
        text = rng.randbytes(arrays[name].nbytes) if rng.random() < 0.5 else bytes(arrays[name].nbytes)
        arrays[name] = np.frombuffer(text, "<i8" if kind == "type" else arrays[name].dtype)
        return encode_part(arrays), f"{kind} of {name}"
    match kind:
        case "values":
            arrays[name] = np.full(arrays[name].shape, rng.choice(NUMBERS)).astype(arrays[name].dtype)
        case "one value" if arrays[name].size:
            arrays[name].reshape(-1)[rng.randrange(arrays[name].size)] = np.array(rng.choice(NUMBERS)).astype(
                arrays[name].dtype
            )
        case "type":
            arrays[name] = arrays[name].astype(rng.choice(("<f4", "<f8", "<i8", "<u1", "|b1", "<c16", "<f2")))
        case "shape":
            some = arrays[name]
            shapes = (
                some.reshape(-1)[:0],
                some.reshape(-1)[:1],
                some[None],
                np.repeat(some.reshape(-1), 3),
                some.sum(),
            )
            arrays[name] = np.asarray(rng.choice(shapes))
        case "missing":
            del arrays[name]
        case "renamed":
            arrays[rng.choice(("x", "", name + "_", "step"))] = arrays.pop(name)
        case _:
            return _header(payload, rng), "a header"
    return encode_part(arrays), f"{kind} of {name}"


def _header(payload: bytes, rng: random.Random) -> bytes:
    """A payload with a forged header."""
    end = 8 + struct.unpack_from("<I", payload, 4)[0]
    header = json.loads(payload[8:end])
    kind = rng.choice(("type", "shape", "shape", "text"))
    entry = rng.choice(header)
    if kind == "type":
        entry[1] = rng.choice(TYPES)
    elif kind == "shape":
        entry[2] = rng.choice(SHAPES)
    text = (_text(json.dumps(header), rng) if kind == "text" else json.dumps(header)).encode()
    return payload[:4] + struct.pack("<I", len(text)) + text + payload[end:]


def _names(folder: Path, rng: random.Random) -> str:
    """The names of parts, and which there are."""
    with database(folder / "run.db") as connection:
        parts = [row[0] for row in connection.execute("SELECT DISTINCT part FROM state")]
        part = rng.choice(sorted({name.rstrip("0123456789"): name for name in sorted(parts)}.values()))
        new = rng.choice(
            (None, "x", part + "x", "cell_", "cell_99999999", "elite_-1", "centre_7", "novelty_00001", "map")
        )
        rows = connection.execute("SELECT part, generation, payload FROM state WHERE part = ?", (part,)).fetchall()
        connection.execute("DELETE FROM state WHERE part = ?", (part,))
        for _, at, payload in rows if new is not None else ():
            row = new, at, part_sha256(new, at, payload), payload
            connection.execute("INSERT OR REPLACE INTO state VALUES (?, ?, ?, ?)", row)
        rehash(connection)
    return f"{part} is now {new}"


def _history(folder: Path, rng: random.Random) -> str:
    """A value of the history, in one row or in all, or a row."""
    with database(folder / "run.db") as connection:
        columns = [row[1] for row in connection.execute("PRAGMA table_info(history)")]
        name = rng.choice([*columns[:-3], "generation"])
        (last,) = connection.execute("SELECT max(generation) FROM history").fetchone()
        where = rng.choice(("", "", f" WHERE generation = {rng.choice((0, 1, last))}"))
        value = rng.choice((None, 0, -1, 7, 0.5, 2**62, -(2**63), 1e300, -1e300, float("inf"), "text", b"bytes", ""))
        with suppress(sqlite3.Error):
            if name == "generation" and where:
                connection.execute(
                    rng.choice(("DELETE FROM history", f"UPDATE history SET generation = {2**40}")) + where
                )
            else:
                connection.execute(f"UPDATE history SET {quoted(name)} = ?{where}", (value,))
        rehash(connection)
    return f"{name} is {value!r}{where}"


def _evaluated(folder: Path, rng: random.Random) -> str:
    """The centres that a generation evaluated."""
    with database(folder / "run.db") as connection:
        at, payload = rng.choice(connection.execute("SELECT generation, evaluations FROM history").fetchall())
        values = [*_values(payload)]
        kind = rng.choice(("cut", "doubled", "value", "value", "value", "kinds"))
        if kind == "cut":
            values = values[: rng.randrange(len(values))] if values else [b"N"]
        elif kind == "doubled":
            values *= 2
        elif kind == "value" and values:
            other = (b"N", b"I" + struct.pack("<q", rng.choice((0, -1, 2**62, -(2**63)))))
            real = b"R" + struct.pack("<d", rng.choice(NUMBERS))
            values[rng.randrange(len(values))] = rng.choice((*other, real))
        else:
            values = [b"R" + value[1:] if value[:1] == b"I" else value for value in values]
        connection.execute("UPDATE history SET evaluations = ? WHERE generation = ?", (b"".join(values), at))
        rehash(connection)
    return f"evaluated centres of {at}: {kind}"


def _values(payload: bytes) -> list[bytes]:
    values, at = [], 0
    while at < len(payload):
        size = 1 if payload[at : at + 1] == b"N" else 9
        values.append(payload[at : at + size])
        at += size
    return values


def _schema(folder: Path, rng: random.Random) -> str:
    """Tables that are something else."""
    endless = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT x AS key, x AS value, x FROM n"
    with database(folder / "run.db") as connection:
        kind = rng.choice(("view of meta", "view", "index", "table", "no table"))
        table = rng.choice(("history", "state", "platform", "certification"))
        match kind:
            case "view of meta":
                connection.execute("ALTER TABLE meta RENAME TO other")
                connection.execute(f"CREATE VIEW meta AS {endless}")
            case "view":
                connection.execute(f"ALTER TABLE {table} RENAME TO other")
                connection.execute(f"CREATE VIEW {table} AS SELECT a.* FROM other a, other b, other c")
            case "index":
                connection.execute("CREATE INDEX i ON history (abs(generation))")
            case "table":
                connection.execute("CREATE TABLE more (x)")
            case _:
                connection.execute(f"DROP TABLE {table}")
    return f"schema: {kind} {table}"


def _certified(folder: Path, rng: random.Random) -> str:
    """A certified policy."""
    with database(folder / "run.db") as connection:
        rows = connection.execute("SELECT number, rank, facts, payload FROM certification").fetchall()
        if not rows:
            return "nothing"
        number, rank, facts, payload = rows[0]
        kind, what = rng.choice(("facts", "facts", "arrays", "number")), ""
        new_number, new_rank = number, rank
        if kind == "facts":
            facts = _text(facts, rng)
        elif kind == "arrays":
            payload, what = _payload(payload, rng)
        else:
            new_number, new_rank = rng.choice(((2**62, 0), (-1, 0), (0, -1), ("x", 0), (0, "y")))
        head = f"certification\0{new_number}\0{new_rank}\0{facts}\0".encode(errors="replace")
        row = new_number, new_rank, facts, payload, hashlib.sha256(head + payload).hexdigest()
        statement = "UPDATE certification SET number = ?, rank = ?, facts = ?, payload = ?, sha256 = ?"
        connection.execute(f"{statement} WHERE number = ? AND rank = ?", (*row, number, rank))
    return f"certified {kind} {what}"


def _lock(folder: Path, rng: random.Random) -> str:
    """Who held the lock, and how the session ended."""
    content = {"host": "a", "pid": 1, "since": "2025", "ended": "2026", "how": "all was computed"}
    text = _text(json.dumps(content), rng)
    (folder / "run.lock").write_bytes(text.encode(errors="replace")[: rng.choice((4096, 10**6))])
    return "lock"


def _yaml(folder: Path, rng: random.Random) -> str:
    """The config as the user's editor may have left it."""
    deep = "a: " + "[" * 3000 + "]" * 3000
    aliases = "a0: &a0 [1, 1]\n" + "".join(f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}]\n" for n in range(1, 40))
    nested = "budget: {generations: " + "{a: " * 200 + "1" + "}" * 201
    (folder / "config.yaml").write_text(rng.choice((deep, aliases, nested, "budget: 3", "budget: {generations: [1]}")))
    return "config.yaml"


def rehash(connection: sqlite3.Connection) -> None:
    """Give every row of the history the SHA-256s of what it has now, as far as a row can have one."""
    states: dict[int, dict[str, tuple[int, str]]] = {}
    for part, at, sha256, size in connection.execute("SELECT part, generation, sha256, length(payload) FROM state"):
        states.setdefault(at, {})[part] = (at, sha256 if size else "")
    (text,) = connection.execute("SELECT value FROM meta WHERE key = 'run'").fetchone()
    names = [row[1] for row in connection.execute("PRAGMA table_info(history)")][:-3]
    heading = json.dumps([[name, "REAL"] for name in names]).encode()
    with suppress(Exception):  # what has no columns any more has no heading either
        heading = column_bytes([Column(**column) for column in json.loads(text)["columns"]])
    in_force: dict[str, tuple[int, str]] = {}
    total = 0
    rows = connection.execute("SELECT * FROM history ORDER BY generation").fetchall()
    for at in sorted({*states, *(row[0] for row in rows)}):
        new = states.get(at, {})
        total = changed_sum(total, {part: in_force[part] for part in new if part in in_force}, new)
        in_force |= new
        for row in rows:
            if row[0] == at:
                state = state_sha256(total)
                with suppress(ValueError, TypeError, struct.error):
                    sha256 = row_sha256(heading, row[:-3], row[-3], state)
                    values = state, sha256, at
                    connection.execute("UPDATE history SET state_sha256 = ?, sha256 = ? WHERE generation = ?", values)
