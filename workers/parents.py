"""The parents of policies that a worker keeps, of which it makes the policies, by the rules of `kept_parents.py`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter

from es_service.protocol.kept_parents import KeptParents, with_parents
from es_service.protocol.messages import FloatArray, Work
from es_service.protocol.recipes import Origin, Recipes, recipes_again


class Parents:
    """The parents that a worker has been sent, or has made of others."""

    def __init__(self, most_bytes: int, made: Callable[[Recipes], FloatArray]) -> None:
        """Keep nothing yet.

        Args:
            most_bytes: as in `KeptParents`.
            made: `Recipes.made`, or its equal in bits.
        """
        self.kept: KeptParents[FloatArray] = KeptParents(most_bytes, attrgetter("nbytes"))
        self._made = made

    def receive(self, parents: Mapping[bytes, FloatArray | Origin]) -> None:
        """Keep parents, those with an origin after they are made. What cannot be made is lacked."""
        waiting: dict[bytes, Origin] = {}  # they are made together, since a call takes longer than a small policy
        for name, given in parents.items():
            if isinstance(given, Origin):
                if not all(parent in self.kept for parent in (given.x, given.y)) or not _same_rule(given, waiting):
                    self._make(waiting)
                if all(parent in self.kept for parent in (given.x, given.y)):
                    waiting[name] = given
            else:
                self._make(waiting)
                self.kept.add(name, given)
        self._make(waiting)

    def complete(self, work: Sequence[Work]) -> list[Work]:
        """A work item whose recipes have their parents. Raises LackingError."""
        return with_parents(work, self.kept)

    def _make(self, waiting: dict[bytes, Origin]) -> None:
        """Make policies and keep them; none of them waits any more."""
        if waiting:
            made = self._made(recipes_again(list(waiting.values()), self.kept))
            for name, parameters_D in zip(waiting, made, strict=True):
                self.kept.add(name, parameters_D.copy())  # of its own, so that it can be forgotten alone
            waiting.clear()


def _same_rule(origin: Origin, others: Mapping[bytes, Origin]) -> bool:
    return all(origin.rule == other.rule for other in others.values())
