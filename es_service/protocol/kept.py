"""Values that are kept in memory until newer ones need their room."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterable
from typing import TypeVar

Key = TypeVar("Key")
Value = TypeVar("Value")


class Kept(dict[Key, Value]):
    """Values by key, in the order in which they were added or used, and the sum of their sizes.

    Only the methods here may change it: those of `dict` do not count bytes.
    """

    def __init__(self, size_of: Callable[[Value], int]) -> None:
        """Keep nothing yet; `size_of`: bytes of a value."""
        super().__init__()
        self._size_of = size_of
        self.nbytes = 0
        """Bytes of all values."""

    def add(self, key: Key, value: Value) -> None:
        """Keep a value as the newest, in the place of the one that had this key."""
        self.forget(key)
        self[key] = value
        self.nbytes += self._size_of(value)

    def use(self, keys: Iterable[Key]) -> None:
        """Make those that are kept the newest."""
        for key in keys:
            if key in self:
                self[key] = self.pop(key)

    def forget(self, key: Key) -> None:
        """Forget a value if it is kept."""
        if key in self:
            self.nbytes -= self._size_of(self.pop(key))

    def forget_oldest(self, most_bytes: int, most: int = sys.maxsize, spared: Collection[Key] = ()) -> None:
        """Forget the oldest until at most so many bytes and values remain, or the oldest is a spared one."""
        while self.nbytes > most_bytes or len(self) > most:
            if (oldest := next(iter(self))) in spared:
                return
            self.forget(oldest)

    def clear(self) -> None:
        """Forget all."""
        super().clear()
        self.nbytes = 0
