"""Parts of the state that were read lately, decoded: elites of which new policies descend are read again and again."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]
RECENT_BYTES = 128 * 2**20
"""Most bytes that are kept."""


class RecentParts:
    """Parts by name, with the generation of their row. Those that were not asked for the longest are forgotten."""

    def __init__(self, most_bytes: int = RECENT_BYTES) -> None:
        self._kept: OrderedDict[str, tuple[int, Arrays]] = OrderedDict()
        self._most_bytes, self._bytes = most_bytes, 0

    def get(self, name: str, generation: int) -> Arrays | None:
        """A part as a generation has stored it; None if it is not kept. Its arrays are read-only."""
        found = self._kept.get(name)
        if found is None or found[0] != generation:
            return None
        self._kept.move_to_end(name)
        return dict(found[1])

    def add(self, name: str, generation: int, arrays: Arrays) -> None:
        """Keep a part, whose arrays are read-only from now on."""
        if name in self._kept:
            self._forget(name)
        for values in arrays.values():
            values.flags.writeable = False
        self._kept[name] = generation, dict(arrays)
        self._bytes += _bytes(arrays)
        while self._bytes > self._most_bytes:
            self._forget(next(iter(self._kept)))

    def _forget(self, name: str) -> None:
        self._bytes -= _bytes(self._kept.pop(name)[1])


def _bytes(arrays: Arrays) -> int:
    return sum(values.nbytes for values in arrays.values())
