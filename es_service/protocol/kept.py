"""Values that are kept in memory until newer ones need their room."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any, Generic, TypeVar

Key = TypeVar("Key")
Value = TypeVar("Value")


class Kept(Mapping[Key, Value], Generic[Key, Value]):
    """Values by key, in the order in which they were added or used, and the sum of their sizes."""

    def __init__(self, size_of: Callable[[Value], int]) -> None:
        """Keep nothing yet; `size_of`: bytes of a value."""
        self._kept: dict[Key, Value] = {}
        self._size_of, self._bytes = size_of, 0

    @property
    def nbytes(self) -> int:
        """Bytes of all values."""
        return self._bytes

    def add(self, key: Key, value: Value) -> None:
        """Keep a value as the newest, in the place of the one that had this key."""
        self.forget(key)
        self._kept[key] = value
        self._bytes += self._size_of(value)

    def use(self, keys: Iterable[Key]) -> None:
        """Make those that are kept the newest."""
        for key in keys:
            if key in self._kept:
                self._kept[key] = self._kept.pop(key)

    def forget(self, key: Key) -> None:
        """Forget a value if it is kept."""
        if key in self._kept:
            self._bytes -= self._size_of(self._kept.pop(key))

    def forget_oldest(self, most_bytes: int, most: int = sys.maxsize, spared: Collection[Key] = ()) -> None:
        """Forget the oldest until at most so many bytes and values remain, or the oldest is a spared one."""
        while self._bytes > most_bytes or len(self._kept) > most:
            if (oldest := next(iter(self._kept))) in spared:
                return
            self.forget(oldest)

    def clear(self) -> None:
        """Forget all."""
        self._kept.clear()
        self._bytes = 0

    def get(self, key: Key, default: Any = None) -> Any:
        """A value, or the default; it is not used by that."""
        return self._kept.get(key, default)

    def __getitem__(self, key: Key) -> Value:
        return self._kept[key]

    def __contains__(self, key: object) -> bool:
        return key in self._kept

    def __iter__(self) -> Iterator[Key]:
        return iter(self._kept)

    def __len__(self) -> int:
        return len(self._kept)
