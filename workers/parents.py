"""The parents of policies that a worker keeps, of which it makes the policies, by the rules of `kept_parents.py`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter

from es_service.protocol.kept_parents import KeptParents, with_parents
from es_service.protocol.messages import FloatArray, Work
from es_service.protocol.recipes import Origin, Recipes


class Parents:
    """The parents that a worker has been sent, or has made of others."""

    def __init__(self, most_bytes: int, made: Callable[[Recipes], FloatArray]) -> None:
        """Keep nothing yet.

        Args:
            most_bytes: as in `KeptParents`.
            made: `Recipes.made`, or what has its bits.
        """
        self.kept: KeptParents[FloatArray] = KeptParents(most_bytes, attrgetter("nbytes"))
        self._made = made

    def receive(self, parents: Mapping[bytes, FloatArray | Origin]) -> None:
        """Keep parents, those with an origin after they are made. What cannot be made is lacked."""
        for name, given in parents.items():
            if not isinstance(given, Origin):
                self.kept.add(name, given)
            elif given.x in self.kept and given.y in self.kept:
                self.kept.add(name, self._made(given.recipes(self.kept))[0])

    def complete(self, work: Sequence[Work]) -> list[Work]:
        """A work item whose recipes have their parents. Raises LackingError."""
        return with_parents(work, self.kept)
