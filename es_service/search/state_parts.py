"""What a search of the user's own remembers besides centres, novelty archive and map, and how it is stored.

`Algorithm.extra` declares it, by name, with its initial values, and `SearchState.extra` has the present ones. A
value is

* a NumPy array: all of these are stored together, whenever one of them differs;
* `Whole`: arrays that are stored together, apart from those of other names;
* `Appended`: arrays that usually grow along axis 0; only blocks of rows that differ are stored;
* `ByCell`: arrays for each of some cells, or of whatever else has a number; only entries that differ are stored.

The store compares contents, so every change is kept: values, types and shapes, rows and entries that come, change and
leave, and names that come and go. Values are read-only; to change one, return a state with another mapping:

    replace(state, extra={**state.extra, "tries": ByCell({**state.extra["tries"].entries, cell: {"count": count}})})
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

Arrays = Mapping[str, NDArray[Any]]
"""Name -> array."""
Key = TypeVar("Key")
Value = TypeVar("Value")

OWN = "own"
"""Name under which the plain arrays are stored together."""
WHOLE_PREFIX, APPENDED_PREFIX, BY_CELL_PREFIX = "whole_", "rows_", "cells_"
"""Prefixes of the names under which the other values are stored."""
PIECE = "/"
"""Separates the name of a stored value and the number of its piece."""
BLOCK_ROWS, BLOCK_BYTES = 256, 1 << 18
"""Most rows of a block of `Appended`, and most bytes of a block with more than one row."""
_NUMERIC_KINDS = "biufc"


class ReadOnly(Mapping[Key, Value], Generic[Key, Value]):
    """A mapping that cannot be changed."""

    def __init__(self, content: Mapping[Key, Value]) -> None:
        """A mapping with the present content of another one."""
        self._content = dict(content)

    def __getitem__(self, key: Key) -> Value:
        return self._content[key]

    def __iter__(self) -> Iterator[Key]:
        return iter(self._content)

    def __len__(self) -> int:
        return len(self._content)

    def __repr__(self) -> str:
        return repr(self._content)


def freeze(values: Iterable[Any]) -> None:
    """Make arrays read-only, with the arrays of which they are views."""
    for value in values:
        while isinstance(value, np.ndarray):  # a NumPy scalar is read-only; whatever else there is, `problem` refuses
            value.flags.writeable = False
            value = value.base


def read_only(extra: Mapping[str, Any]) -> Mapping[str, Any]:
    """The same values, with arrays made read-only, in a read-only mapping; itself if it is such a mapping."""
    if isinstance(extra, ReadOnly):
        return extra
    # A resumed run has arrays in C order; in another one, sums of the same values may have other bits.
    ordered = {
        name: np.array(value, order="C") if isinstance(value, np.ndarray) and not value.flags.c_contiguous else value
        for name, value in extra.items()
    }
    freeze(ordered.values())
    return ReadOnly(ordered)


@dataclass(frozen=True, eq=False)
class Whole:
    """Arrays that are stored together whenever one of them differs."""

    arrays: Arrays

    def __post_init__(self) -> None:
        object.__setattr__(self, "arrays", read_only(self.arrays))


@dataclass(frozen=True, eq=False)
class Appended:
    """Arrays with the same number of rows, on axis 0, of which usually only the last rows are new."""

    arrays: Arrays

    def __post_init__(self) -> None:
        object.__setattr__(self, "arrays", read_only(self.arrays))


@dataclass(frozen=True, eq=False)
class ByCell:
    """Arrays for each of some cells; the cells need not be those of the map. Their order is not kept."""

    entries: Mapping[int, Arrays] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.entries, ReadOnly):
            known = (
                (int(cell) if isinstance(cell, np.integer) else cell, content) for cell, content in self.entries.items()
            )
            frozen = {cell: read_only(arrays) for cell, arrays in sorted(known, key=lambda entry: entry[0])}
            object.__setattr__(self, "entries", ReadOnly(frozen))


Named = Whole | Appended | ByCell


def problem(extra: Mapping[str, Any], before: Mapping[str, Any] = MappingProxyType({})) -> str:
    """Why values cannot be stored; empty if they can.

    Args:
        before: values that can be; entries of `ByCell` that are the same objects are not looked at again.
    """
    for name, value in extra.items():
        what = f"its own value {name!r}"
        if not isinstance(value, Named):
            if not _is_array(value):
                return (
                    f"{what} is {_kind(value)}; it must be a NumPy array of bools or numbers, Whole, Appended or ByCell"
                )
            continue
        if not name.isidentifier():
            return f"the name of {what} is no Python identifier"
        entries, then = value.entries if isinstance(value, ByCell) else {}, before.get(name)
        known = then.entries if isinstance(then, ByCell) else {}
        new = {cell: arrays for cell, arrays in entries.items() if known.get(cell) is not arrays}
        if not all(isinstance(cell, int) and cell >= 0 for cell in new):
            return f"{what} has cells that are no whole numbers from 0 on"
        every = new.values() if isinstance(value, ByCell) else [value.arrays]
        wrong = [array for arrays in every for array in arrays.values() if not _is_array(array)]
        if wrong:
            return f"{what} has {_kind(wrong[0])} where a NumPy array of bools or numbers must be"
        counts = {array.shape[:1] for array in value.arrays.values()} if isinstance(value, Appended) else {(0,)}
        if len(counts) != 1 or () in counts:
            return f"{what} must have one or more arrays, all with the same number of rows"
    return ""


def changes(extra: Mapping[str, Any], before: Mapping[str, Any]) -> dict[str, Arrays | None]:
    """The pieces in which values differ from earlier ones, by their names in the store; None for those that are gone.

    With an empty `before`, all pieces.
    """
    differing: dict[str, Arrays | None] = {}
    now_by_name, then_by_name = ({}, {}) if extra is before else (_stored(extra), _stored(before))
    for name in [*now_by_name, *(then_by_name.keys() - now_by_name.keys())]:
        now, then = now_by_name.get(name), then_by_name.get(name)
        if now is then:
            continue
        first = _same_first(now.arrays, then.arrays) if isinstance(now, Appended) and isinstance(then, Appended) else 0
        pieces, earlier = _pieces(now, first), _pieces(then, first)
        for number in [*pieces, *(earlier.keys() - pieces.keys())]:
            arrays, arrays_then = pieces.get(number), earlier.get(number)
            if arrays is None or arrays_then is None or not same_arrays(arrays, arrays_then):
                differing[name if number is None else f"{name}{PIECE}{number:08d}"] = arrays
    return differing


def from_parts(parts: Mapping[str, Arrays]) -> Mapping[str, Any]:
    """The values whose pieces are among the parts of a state; inverse of `changes(extra, {})`."""
    values: dict[str, Any] = dict(parts.get(OWN, {}))
    numbered: dict[str, dict[int, Arrays]] = {}
    for name, arrays in parts.items():
        whole, is_piece, number = name.partition(PIECE)
        if name.startswith(WHOLE_PREFIX):
            values[name.removeprefix(WHOLE_PREFIX)] = Whole(arrays)
        elif whole.startswith((APPENDED_PREFIX, BY_CELL_PREFIX)):
            numbered.setdefault(whole, {}).update({int(number): arrays} if is_piece else {})
    for whole, entries in numbered.items():
        if whole.startswith(BY_CELL_PREFIX):
            values[whole.removeprefix(BY_CELL_PREFIX)] = ByCell(entries)
        else:
            blocks = [entries[number] for number in sorted(entries)]
            joined = {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
            values[whole.removeprefix(APPENDED_PREFIX)] = Appended(joined)
    return read_only(values)


def same_arrays(now: Arrays, then: Arrays) -> bool:
    """Whether arrays by name have the same types, shapes and bits."""
    if now is then:
        return True
    # Small arrays first: of a centre that has moved, a count says so.
    names = sorted(now, key=lambda name: now[name].size)
    return now.keys() == then.keys() and all(_is_same(now[name], then[name]) for name in names)


def same_rows(now: np.ndarray, then: np.ndarray) -> int:
    """Number of first rows in which two arrays of one type and shape have the same bits."""
    same = (_bits(now) == _bits(then)).reshape(len(now), -1).all(axis=1) if len(now) else np.ones(0, bool)
    return len(now) if same.all() else int(np.argmin(same))


def _is_same(now: np.ndarray, then: np.ndarray) -> bool:
    if now is then:  # both are read-only
        return True
    return now.dtype == then.dtype and now.shape == then.shape and bool((_bits(now) == _bits(then)).all())


def _bits(values: np.ndarray) -> np.ndarray:
    """An array as unsigned integers of the same bits: NaN then equals itself, and 0 differs from -0."""
    unsigned = {1: np.uint8, 2: np.uint16, 4: np.uint32, 8: np.uint64}.get(values.dtype.itemsize)
    return values.view(unsigned) if unsigned else np.frombuffer(values.tobytes(), np.uint8)


def _stored(extra: Mapping[str, Any]) -> dict[str, Named]:
    """Values by their names in the store."""
    prefixes = {Whole: WHOLE_PREFIX, Appended: APPENDED_PREFIX, ByCell: BY_CELL_PREFIX}
    named = {prefixes[type(value)] + name: value for name, value in extra.items() if isinstance(value, Named)}
    plain = {name: value for name, value in extra.items() if not isinstance(value, Named)}
    return {OWN: Whole(plain), **named} if plain else named


def _pieces(value: Named | None, first: int) -> Mapping[int | None, Arrays]:
    """The pieces in which a value is stored, by number; None is the number of its head.

    Those of `Appended` are blocks of rows, whose size depends on types and shapes alone; no rows are one block, too.

    Args:
        first: row of `Appended` from which on blocks are wanted.
    """
    if isinstance(value, Whole):
        return {None: value.arrays}
    if isinstance(value, ByCell):
        return {None: {}, **value.entries}
    if value is None:
        return {}
    row_bytes = sum(array.dtype.itemsize * math.prod(array.shape[1:]) for array in value.arrays.values())
    rows = max(1, min(BLOCK_ROWS, BLOCK_BYTES // max(1, row_bytes)))
    count = len(next(iter(value.arrays.values())))
    blocks = range(first // rows, max(1, -(-count // rows)))
    return {
        block: {name: array[block * rows : (block + 1) * rows] for name, array in value.arrays.items()}
        for block in blocks
    }


def _same_first(now: Arrays, then: Arrays) -> int:
    """Number of first rows in which arrays are the same; 0 if they have other names, types or shapes of rows."""
    if {name: (array.dtype, array.shape[1:]) for name, array in now.items()} != {
        name: (array.dtype, array.shape[1:]) for name, array in then.items()
    }:
        return 0
    count = min(len(next(iter(arrays.values()))) for arrays in (now, then))
    for name in now:
        count = same_rows(now[name][:count], then[name][:count])
    return count


def _is_array(value: object) -> bool:
    return isinstance(value, np.ndarray | np.generic) and value.dtype.kind in _NUMERIC_KINDS


def _kind(value: object) -> str:
    return f"an array of {value.dtype}" if isinstance(value, np.ndarray) else f"a {type(value).__name__}"
