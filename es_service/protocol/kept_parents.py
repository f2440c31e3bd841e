"""Parents that a worker keeps, so that each is sent to it once: what worker and sender both do, in the same order.

For each work item, the sender sends the parents of recipes that the worker lacks, and then the item. A parent that was
made of others by a recipe is made again by the worker, if it has those, and only its origin travels. The worker keeps
their parameters in a `KeptParents`, and the sender their sizes in another one. Both make the same changes, and so the
sender knows what the worker has, without asking. Should a worker lack something all the same, it says so, the sender
takes it to have nothing (`KeptParents.clear`) and sends the item again: that is no failed attempt, unless it lacks
something again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.kept import Kept
from es_service.protocol.messages import Subject, Work, recipes_in
from es_service.protocol.policies import Policies
from es_service.protocol.recipes import Origin, Recipes, origin_of

Value = TypeVar("Value")
FloatArray = NDArray[np.float32]


LACKS_AGAIN = "it lacks parents of policies, though it was sent all of them"
"""Message of the failure of a worker that says twice of a work item that it lacks something."""


class LackingError(Exception):
    """A worker lacks parents of policies that it must make."""


class KeptParents(Kept[bytes, Value]):
    """Parents by name, of which those are forgotten that were not needed for the longest time.

    What the worker has and its sender does not know of is always older than the rest, and so forgotten first.
    """

    def __init__(self, most_bytes: int, size_of: Callable[[Value], int]) -> None:
        """Keep nothing yet.

        Args:
            most_bytes: limit of the sizes together. Parents that one work item needs are kept beyond it.
        """
        super().__init__(size_of)
        self._most_bytes = most_bytes

    def needed(self, names: Iterable[bytes]) -> None:
        """Make the parents that a work item needs the newest, and forget the oldest others beyond the limit."""
        wanted = dict.fromkeys(names)
        self.use(wanted)
        self.forget_oldest(self._most_bytes, spared=wanted)


LEAST_BYTES = 1 << 12
"""Bytes of the smallest parent whose origin travels instead of itself."""
MOST_STEPS = 4
"""Most policies that a worker makes for one parent that it lacks, which may descend from others that it lacks."""


def parents_to_send(work: Sequence[Work], kept: KeptParents[int]) -> dict[bytes, FloatArray | Origin]:
    """The parents that a work item needs and its worker lacks, by name: parameters, or the origins of those that it can
    make of what it has and of what comes before.

    Args:
        kept: sizes of those that the worker has; now with the others.
    """
    needed: dict[bytes, FloatArray] = {}
    for recipes in _recipes_of(work):
        needed.update(zip(recipes.names, recipes.parents, strict=True))
    sent: dict[bytes, FloatArray | Origin] = {}
    for name, parameters_D in needed.items():
        if name not in kept:
            steps = _steps(name, kept) if parameters_D.nbytes >= LEAST_BYTES else None
            for parent_name, given in ({name: parameters_D} if steps is None else steps).items():
                kept.add(parent_name, parameters_D.nbytes)
                sent[parent_name] = given
    kept.needed(needed)
    return sent


def apart(parents: Mapping[bytes, FloatArray | Origin]) -> list[dict[bytes, FloatArray | Origin]]:
    """Parents in their order, as several messages: each that travels by itself has its own, which may be large."""
    messages: list[dict[bytes, FloatArray | Origin]] = []
    before = False
    for name, given in parents.items():
        is_origin = isinstance(given, Origin)
        if is_origin and before:
            messages[-1][name] = given
        else:
            messages.append({name: given})
        before = is_origin
    return messages


def _steps(name: bytes, kept: KeptParents[int]) -> dict[bytes, Origin] | None:
    """The origins of policies to make one after another, the last of which is the one that is named; None if they are
    not remembered, or too many."""
    steps: dict[bytes, Origin] = {}
    waiting = [name]
    while waiting:
        policy_name = waiting.pop(0)
        if policy_name in kept:
            continue
        if (origin := origin_of(policy_name)) is None or (len(steps) == MOST_STEPS and policy_name not in steps):
            return None
        steps.pop(policy_name, None)  # what descends from it comes after it
        steps[policy_name] = origin
        waiting += origin.x, origin.y
    return dict(reversed(steps.items()))


def with_parents(work: Sequence[Work], kept: KeptParents[FloatArray]) -> list[Work]:
    """A work item whose recipes have the parameters of their parents.

    Args:
        kept: parents that the worker has; some may be forgotten now.

    Raises:
        LackingError: the worker lacks some.
    """
    if not (all_recipes := list(_recipes_of(work))):
        return list(work)
    if any(name not in kept for recipes in all_recipes for name in recipes.names):
        raise LackingError
    subjects = {id(subject): _with(subject, lambda recipes: recipes.complete(kept)) for subject, _ in work}
    kept.needed(name for recipes in all_recipes for name in recipes.names)
    return [(subjects[id(subject)], chunk) for subject, chunk in work]


def with_made_policies(work: Sequence[Work]) -> list[Work]:
    """A work item with the parameters of policies in the place of their recipes, which need more bytes with the
    parents."""
    subjects = {id(subject): _with(subject, Recipes.made) for subject, _ in work}
    return [(subjects[id(subject)], chunk) for subject, chunk in work]


def as_sent(subject: Subject) -> Subject:
    """A subject without the parameters of parents."""
    return _with(subject, Recipes.as_sent)


def _recipes_of(work: Sequence[Work]) -> Iterator[Recipes]:
    """The recipes of a work item's subjects, each once, in their order."""
    for subject in {id(subject): subject for subject, _ in work}.values():
        if (recipes := recipes_in(subject)) is not None:
            yield recipes


def _with(subject: Subject, change: Callable[[Recipes], Recipes | FloatArray]) -> Subject:
    """A subject with a function of its recipes in their place, if it has any."""
    if isinstance(subject, Policies) and (recipes := recipes_in(subject)) is not None:
        return replace(subject, parameters_N_D=change(recipes))
    return subject
