"""The newest subjects that were sent to a worker: what worker and sender both keep, so that the sender knows what the
worker has."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Generic, TypeVar

Value = TypeVar("Value")

KEPT_SUBJECTS = 64
"""Most subjects that a worker keeps after each work item, so that they need not be sent to it again."""
KEPT_BYTES = 32 * 2**20
"""Most bytes of parameters that it keeps."""


class KeptSubjects(Mapping[int, Value], Generic[Value]):
    """Subjects by number, in the order in which they were added."""

    def __init__(self, size_of: Callable[[Value], int]) -> None:
        """Keep nothing yet.

        Args:
            size_of: bytes of a subject.
        """
        self._kept: dict[int, Value] = {}
        self._size_of, self._bytes = size_of, 0

    def add(self, number: int, value: Value) -> None:
        """Keep a subject, as the newest. Its number must be a new one."""
        self._kept[number] = value
        self._bytes += self._size_of(value)

    def forget_oldest(self) -> None:
        """Forget the oldest, so that at most KEPT_SUBJECTS and KEPT_BYTES remain, or one. Worker and sender both do so
        after each work item."""
        while len(self._kept) > 1 and (len(self._kept) > KEPT_SUBJECTS or self._bytes > KEPT_BYTES):
            self._bytes -= self._size_of(self._kept.pop(next(iter(self._kept))))

    def clear(self) -> None:
        """Forget all."""
        self._kept.clear()
        self._bytes = 0

    def __getitem__(self, number: int) -> Value:
        return self._kept[number]

    def __contains__(self, number: object) -> bool:
        return number in self._kept

    def __iter__(self):
        return iter(self._kept)

    def __len__(self) -> int:
        return len(self._kept)
