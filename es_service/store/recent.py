"""Parts of the state that were read lately, decoded: elites of which new policies descend are read again and again."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from numpy.typing import NDArray

Arrays = Mapping[str, NDArray[Any]]
RECENT_BYTES = 128 * 2**20
"""Most bytes that are kept."""


class RecentParts:
    """Parts by name. Those that were not asked for the longest are forgotten."""

    def __init__(self, most_bytes: int = RECENT_BYTES) -> None:
        self._kept: OrderedDict[str, Arrays] = OrderedDict()
        self._most_bytes, self._bytes = most_bytes, 0

    def get(self, name: str) -> Arrays | None:
        """A part, read-only as its arrays are; None if it is not kept."""
        if (found := self._kept.get(name)) is not None:
            self._kept.move_to_end(name)
        return found

    def add(self, name: str, arrays: Arrays) -> Arrays:
        """Keep a part that is not kept, whose arrays are read-only from now on; returns what `get` would."""
        for values in arrays.values():
            values.flags.writeable = False
        self._kept[name] = added = MappingProxyType(dict(arrays))
        self._bytes += _bytes(arrays)
        while self._bytes > self._most_bytes:
            self.forget(next(iter(self._kept)))
        return added

    def forget(self, name: str) -> None:
        """Forget a part if it is kept, as it must be once it has changed."""
        if (gone := self._kept.pop(name, None)) is not None:
            self._bytes -= _bytes(gone)


def _bytes(arrays: Arrays) -> int:
    return sum(values.nbytes for values in arrays.values())
