"""Damage to the files of a run, drawn from a seed: what disks, memory, interrupted copies and editors do to them.

`damage_bytes` works on any file, `damage_rows` on a database, `edit_text` on a config.
"""

from __future__ import annotations

import contextlib
import random
import sqlite3
from collections.abc import Callable
from pathlib import Path

from tests.database import database

PAGE = 8192
"""Bytes of a page of the database."""
VALUES = (None, 0, -1, 7, 2**62, 0.5, -1e300, float("inf"), "", "text", "é\0", b"", b"\xff" * 9)
"""What a damaged column may hold."""
WORDS = ("", "0", "-1", "1e9", "null", "[]", "{}", "true", ".nan", "point_maze", "\0", "é", "\t", "- ", "'", "9" * 40)
"""What an editor may leave in a config."""


def damage_bytes(file: Path, rng: random.Random) -> str:
    """Change the bytes of a file; returns the kind of damage."""
    content = bytearray(file.read_bytes())
    kind = rng.choice(tuple(_KINDS))
    if content:
        _KINDS[kind](content, rng)
    file.write_bytes(content)
    return kind


def _flip(content: bytearray, rng: random.Random) -> None:
    for _ in range(rng.choice((1, 1, 8))):
        content[_place(content, rng)] ^= 1 << rng.randrange(8)


def _place(content: bytearray, rng: random.Random) -> int:
    """Half of the places are where something is stored, since short databases consist mostly of zeros."""
    for _ in range(rng.choice((0, 50))):
        if content[place := rng.randrange(len(content))]:
            return place
    return rng.randrange(len(content))


def _cut(content: bytearray, rng: random.Random) -> None:
    del content[rng.randrange(len(content)) :]


def _append(content: bytearray, rng: random.Random) -> None:
    content += rng.randbytes(rng.choice((1, 100, PAGE)))


def _overwrite(content: bytearray, rng: random.Random) -> None:
    at, size = _place(content, rng), rng.choice((2, 16, 512, PAGE))
    content[at : at + size] = rng.randbytes(len(content[at : at + size]))


def _zero(content: bytearray, rng: random.Random) -> None:
    size = rng.choice((4, 512, PAGE))
    at = _place(content, rng) if size < PAGE else rng.randrange(len(content)) // PAGE * PAGE
    content[at : at + size] = bytes(len(content[at : at + size]))


def _pages(content: bytearray, rng: random.Random) -> tuple[slice, slice]:
    one, other = (rng.randrange(-(-len(content) // PAGE)) * PAGE for _ in range(2))
    return slice(one, one + PAGE), slice(other, other + PAGE)


def _swap_pages(content: bytearray, rng: random.Random) -> None:
    one, other = _pages(content, rng)
    content[one], content[other] = content[other], content[one]


def _repeat_page(content: bytearray, rng: random.Random) -> None:
    one, other = _pages(content, rng)
    content[one] = content[other]


def _remove(content: bytearray, rng: random.Random) -> None:
    at = _place(content, rng)
    del content[at : at + rng.choice((1, 100, PAGE))]


def _insert(content: bytearray, rng: random.Random) -> None:
    at = _place(content, rng)
    content[at:at] = rng.choice((content[at : at + 64], rng.randbytes(16)))


def _replace_all(content: bytearray, rng: random.Random) -> None:
    content[:] = rng.choice((b"", b"text\n", rng.randbytes(len(content))))


_KINDS: dict[str, Callable[[bytearray, random.Random], None]] = {
    "bits flipped": _flip,
    "bits flipped again": _flip,
    "cut off": _cut,
    "appended": _append,
    "range overwritten": _overwrite,
    "range zeroed": _zero,
    "pages swapped": _swap_pages,
    "page repeated": _repeat_page,
    "bytes removed": _remove,
    "bytes inserted": _insert,
    "all replaced": _replace_all,
}


def damage_rows(file: Path, rng: random.Random) -> str:
    """Change rows of a database behind the back of the store, without new SHA-256s; returns the kind of damage."""
    table = rng.choice(("history", "state", "state", "platform", "meta"))
    kind = rng.choice(("deleted", "deleted too", "duplicated", "edited", "edited too"))
    with database(file) as connection:
        rows = connection.execute(f"SELECT * FROM {table}").fetchall()
        names = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
        chosen = rng.sample(rows, rng.randint(1, len(rows)) if kind == "deleted too" else 1)
        where = " AND ".join(f'"{name}" IS ?' for name in names)
        with contextlib.suppress(sqlite3.IntegrityError, sqlite3.OperationalError):  # values that no row can have
            for row in chosen:
                name = rng.choice(names)
                value = rng.choice((*VALUES, *(other[names.index(name)] for other in rows)))
                if kind.startswith("deleted"):
                    connection.execute(f"DELETE FROM {table} WHERE {where}", row)
                elif kind == "duplicated":
                    name = "generation" if "generation" in names else "key"
                    other = [value if column == name else old for column, old in zip(names, row, strict=True)]
                    connection.execute(f"INSERT OR REPLACE INTO {table} VALUES ({','.join('?' * len(names))})", other)
                else:
                    connection.execute(f'UPDATE OR REPLACE {table} SET "{name}" = ? WHERE {where}', (value, *row))
    return f"row of {table} {kind}"


def edit_text(file: Path, rng: random.Random) -> str:
    """Edit a YAML file as a careless editor might; returns the kind of edit."""
    lines = file.read_text().splitlines()
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind = rng.choice(("value", "value too", "deleted", "doubled", "swapped", "indented", "key"))
    key, colon, value = lines[at].partition(":")
    match kind:
        case "deleted":
            del lines[at]
        case "doubled":
            lines.insert(other, lines[at])
        case "swapped":
            lines[at], lines[other] = lines[other], lines[at]
        case "indented":
            lines[at] = rng.choice(("  ", "\t", "")) + lines[at].strip()
        case "key":
            lines[at] = f"{key}{rng.choice(WORDS)}{colon}{value}"
        case _:
            lines[at] = f"{key}{colon} {rng.choice((*WORDS, lines[other].partition(':')[2]))}"
    file.write_bytes("\n".join(lines).encode())
    return f"line {kind}"
