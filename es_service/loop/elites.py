"""Elites by cell, as searches draw them: those that were needed lately are kept in memory, decoded."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from es_service.loop.parts import ELITE_PREFIX, Changes, elite_from_arrays, elite_part
from es_service.protocol.kept import Kept
from es_service.search.maps.behaviour_map import Elite

RECENT_BYTES = 256 * 2**20
"""Most bytes that are kept of elites that the store has: 400 of an ant with a 256x256 policy are 155 MB."""


class Elites:
    """Function from a cell to its elite, whose arrays are read-only. The newest generation need not be stored yet."""

    def __init__(self, part: Callable[[str], Mapping[str, np.ndarray]], most_bytes: int = RECENT_BYTES) -> None:
        """Keep nothing yet.

        Args:
            part: returns a part of the state of the newest generation that is stored; raises KeyError if it has none.
        """
        self._part, self._most_bytes = part, most_bytes
        self._kept: Kept[int, Elite] = Kept(lambda elite: sum(array.nbytes for array in vars(elite).values()))
        self._new: dict[int, Elite | None] = {}
        """Of the generation that is not stored; None if it has emptied the cell."""

    def __call__(self, cell: int) -> Elite:
        """The elite of a cell. Raises KeyError if there is none."""
        return self.of([cell])[cell]

    def of(self, cells: Sequence[int]) -> dict[int, Elite]:
        """The elites of cells. Raises KeyError if there is none in one of them."""
        kept, new = self._kept, self._new
        kept.use(cells)
        asked = dict.fromkeys(cells)
        return {cell: (new[cell] if cell in new else kept.get(cell)) or self._read(cell, asked) for cell in asked}

    def _read(self, cell: int, asked: Collection[int]) -> Elite:
        """An elite that is only in the store. It takes the place of none that was asked for with it: a batch of mutants
        asks for nearly the whole map, and if that is too large, each elite would otherwise be gone when it is needed.
        """
        if cell in self._new:
            raise KeyError(cell)
        return self._keep(cell, _read_only(elite_from_arrays(self._part(elite_part(cell)))), asked)

    def change(self, parts: Changes) -> None:
        """Take in what a generation has changed, before it is stored."""
        for name, arrays in parts.items():
            if name.startswith(ELITE_PREFIX):
                cell = int(name.removeprefix(ELITE_PREFIX))
                self._new[cell] = None if arrays is None else _read_only(elite_from_arrays(arrays))

    def stored(self) -> None:
        """The store has what was changed."""
        for cell, elite in self._new.items():
            self._kept.forget(cell)
            if elite is not None:
                self._keep(cell, elite)
        self._new.clear()

    def _keep(self, cell: int, elite: Elite, spared: Collection[int] = ()) -> Elite:
        """Keep an elite as the newest, and forget those that were not asked for the longest, or else this one."""
        self._kept.add(cell, elite)
        self._kept.forget_oldest(self._most_bytes, spared=spared)
        if self._kept.nbytes > self._most_bytes:
            self._kept.forget(cell)
        return elite


def _read_only(elite: Elite) -> Elite:
    """The elite in arrays that nobody changes: those that are not read-only are copied."""
    copies = {name: array.copy() for name, array in vars(elite).items() if array.flags.writeable}
    for copy in copies.values():
        copy.flags.writeable = False
    return replace(elite, **copies) if copies else elite
