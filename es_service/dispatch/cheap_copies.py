"""Containers with cheap copies, for states that are kept: a table and a sorted list.

`scheduler.step` must leave the state that it is given as it is, so it copies the containers and changes the copies. A
copy of a dict or a list takes time in proportion to its size. Here a copy shares almost everything with its original,
and neither ever sees a later change of the other. With 10,000 entries, a copy or a change takes about a microsecond;
this time grows with the square root of the size.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator
from itertools import chain
from operator import itemgetter
from typing import Any, Generic, TypeVar, cast

Key = TypeVar("Key")
Value = TypeVar("Value")
Entry = TypeVar("Entry", bound=tuple[Any, ...])

_FIRST = itemgetter(0)
_LONGEST, _SHORTEST = 128, 32
"""Most entries of a block of `Sorted`, and fewest of a block that has a neighbour."""


class Table(Generic[Key, Value]):
    """A dict whose copies share a large dict that never changes; each has a small dict of its own with the differences.

    Once the small dict has about as many entries as the square root of the size, the next copy merges the two. The
    order of iteration is that of a dict, unless a removed key is inserted again. No value is None.
    """

    __slots__ = ("_differences", "_shared", "_size")

    def __init__(
        self,
        shared: dict[Key, Value] | None = None,
        differences: dict[Key, Value | None] | None = None,
        size: int = 0,
    ) -> None:
        self._shared = {} if shared is None else shared
        self._differences = {} if differences is None else differences
        """New values, and None for each key of `_shared` that was removed."""
        self._size = size

    def copy(self) -> Table[Key, Value]:
        if len(self._differences) ** 2 > 4 * len(self._shared) + 256:
            return Table(self._merged(), {}, self._size)
        return Table(self._shared, self._differences.copy(), self._size)

    def get(self, key: Key) -> Value | None:
        """The value of a key; None if there is none."""
        return self._differences.get(key, self._shared.get(key))

    def pop(self, key: Key) -> Value | None:
        """Remove a key and return its value; None if there was none."""
        value = self.get(key)
        if value is not None:
            self._size -= 1
            if key in self._shared:
                self._differences[key] = None
            else:
                del self._differences[key]
        return value

    def __getitem__(self, key: Key) -> Value:
        value = self._differences.get(key, self._shared.get(key))
        if value is None:
            raise KeyError(key)
        return value

    def __setitem__(self, key: Key, value: Value) -> None:
        if self._differences.get(key, self._shared.get(key)) is None:
            self._size += 1
        self._differences[key] = value

    def __contains__(self, key: Key) -> bool:
        return self.get(key) is not None

    def __iter__(self) -> Iterator[Key]:
        return iter(self._merged())

    def __len__(self) -> int:
        return self._size

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Table) and self._merged() == other._merged()

    def __repr__(self) -> str:
        return f"Table({self._merged()})"

    def _merged(self) -> dict[Key, Value]:
        merged = self._shared | cast("dict[Key, Value]", self._differences)
        for key, value in self._differences.items():
            if value is None:
                del merged[key]
        return merged


class Sorted(Generic[Entry]):
    """A sorted list of different tuples, in blocks that copies share."""

    __slots__ = ("_blocks",)

    def __init__(self, blocks: tuple[tuple[Entry, ...], ...] = ()) -> None:
        self._blocks = blocks
        """None is empty; the lengths of all but a single one are between _SHORTEST and _LONGEST."""

    def copy(self) -> Sorted[Entry]:
        return Sorted(self._blocks)

    def first(self) -> Entry | None:
        """The smallest entry; None if there is none."""
        return self._blocks[0][0] if self._blocks else None

    def last(self) -> Entry | None:
        """The largest entry; None if there is none."""
        return self._blocks[-1][-1] if self._blocks else None

    def add(self, entry: Entry) -> None:
        """Insert an entry, which must not be there yet."""
        blocks = self._blocks
        at = max(0, bisect_right(blocks, entry, key=_FIRST) - 1)
        block = blocks[at] if blocks else ()
        index = bisect_left(block, entry)
        self._replace(at, (*block[:index], entry, *block[index:]))

    def extend(self, entries: Iterable[Entry]) -> None:
        """Add sorted entries that are all larger than those that are there."""
        entries = (*self._blocks[-1], *entries) if self._blocks else tuple(entries)
        count = max(1, 2 * len(entries) // _LONGEST)
        ends = [len(entries) * (number + 1) // count for number in range(count)]
        parts = (entries[start:end] for start, end in zip([0, *ends], ends, strict=False) if end)
        self._blocks = (*self._blocks[:-1], *parts)

    def remove(self, entry: Entry) -> None:
        """Remove an entry, which must be there."""
        at = bisect_right(self._blocks, entry, key=_FIRST) - 1
        block = self._blocks[at]
        index = bisect_left(block, entry)
        if block[index] != entry:
            raise KeyError(entry)
        self._replace(at, block[:index] + block[index + 1 :])

    def __iter__(self) -> Iterator[Entry]:
        """The entries at this moment: later changes have no effect on it."""
        return chain.from_iterable(self._blocks)

    def __len__(self) -> int:
        return sum(map(len, self._blocks))

    def __bool__(self) -> bool:
        return bool(self._blocks)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sorted) and tuple(self) == tuple(other)

    def __repr__(self) -> str:
        return f"Sorted({list(self)})"

    def _replace(self, at: int, block: tuple[Entry, ...]) -> None:
        """Replace a block; the new one is joined with a neighbour if it is too short, and split if it is too long."""
        blocks, end = self._blocks, at + 1
        if len(blocks) < 2 and len(block) <= _LONGEST:
            self._blocks = (block,) if block else ()
            return
        if len(block) < _SHORTEST:
            if end < len(blocks):
                block, end = block + blocks[end], end + 1
            else:
                block, at = blocks[at - 1] + block, at - 1
        half = len(block) // 2
        parts = (block[:half], block[half:]) if len(block) > _LONGEST else (block,)
        self._blocks = blocks[:at] + parts + blocks[end:]
