"""Work on its way to a worker: each array travels to it once, under the name of its content.

A message of work has names in the place of the parameters of centres, of policies and of the parents of recipes. The
worker has these arrays in a `Memory`, and its sender has their sizes in another one. Both make the same changes for
each work item, so the sender knows what the worker lacks. A parent that was made of others by a recipe need not travel
at all: a worker that has those makes it again. Should a worker lack something all the same, it says so; the sender
takes it to have nothing (`Memory.clear`) and sends the item again. That is no failed attempt, unless it lacks something
again.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any, NamedTuple, TypeVar

from numpy.typing import NDArray

from es_service.protocol.content import Cache
from es_service.protocol.messages import Centre, FloatArray, Subject, Work, recipes_in
from es_service.protocol.nearest import ArchiveEntries
from es_service.protocol.policies import Origin, Policies, Recipes, parent_name, recipes_again

Value = TypeVar("Value")

LEAST_BYTES = 1 << 12
"""Bytes of the smallest centre that has a name, and of the smallest parent whose origin travels instead of itself."""
MOST_STEPS = 4
"""Most policies that a worker makes for one parent that it lacks, which may descend from others that it lacks."""
SENDER_BYTES = 32 * 2**20
"""Most bytes of arrays that a sender has ready for other workers."""
LACKS_AGAIN = "it lacks parameters of policies, though it was sent all of them"
"""Message of the failure of a worker that says twice of a work item that it lacks something."""


class LackingError(Exception):
    """A worker lacks arrays of a work item."""


class Memory(Cache[bytes, Value]):
    """What a worker has of the arrays of work, by name: parents of recipes and entries of the novelty archive until
    newer ones need their room, and others until a work item does not need them.

    What the worker has and its sender does not know of is always older than the rest, and so forgotten first.
    """

    def __init__(self, most_bytes: int, size_of: Callable[[Value], int]) -> None:
        """Remember nothing yet; `most_bytes`: limit of the sizes together, beyond which is what one item needs."""
        super().__init__(size_of)
        self._most_bytes = most_bytes
        self._passing: frozenset[bytes] = frozenset()
        """What the last item needed that is none of these."""

    def needed(self, names: Mapping[bytes, object], parents: Collection[bytes]) -> None:
        """Make what a work item needs the newest, and forget what there is no room for.

        Args:
            parents: those of the names that are parents of recipes, or entries of the archive.
        """
        for name in self._passing.difference(names):
            self.forget(name)
        self._passing = frozenset(names).difference(parents)
        self.use(names)
        self.forget_oldest(self._most_bytes, spared=names)


class Parcel(NamedTuple):
    """A work item as it is sent."""

    arrays: dict[bytes, NDArray[Any]]
    """Arrays that the worker lacks, by name; they are sent first."""
    origins: dict[bytes, Origin]
    """Of parents that it makes of these, and of what it has, one after another."""
    work: bytes
    """The pickled work, with names in the place of arrays."""


def parcel(work: Sequence[Work], memory: Memory[int]) -> Parcel:
    """A work item for a worker.

    Args:
        memory: sizes of what the worker has; now with what it is sent.
    """
    needed: dict[bytes, NDArray[Any]] = {}
    origins_of: dict[bytes, Mapping[bytes, Origin]] = {}
    written: dict[int, Subject] = {}
    named_entries: dict[int, ArchiveEntries] = {}
    for subject in {id(subject): subject for subject, _ in work}.values():
        written[id(subject)] = subject
        if (recipes := recipes_in(subject)) is not None:
            named = dict(zip(recipes.names, recipes.parents, strict=True))
            needed |= named
            origins_of |= dict.fromkeys(named, recipes.origins)
            written[id(subject)] = _with(subject, replace(recipes, parents=()))
        elif (array := _parameters(subject)).nbytes >= LEAST_BYTES:
            shape = b"" if array.ndim == 1 else repr(array.shape).encode()  # [1, D] has the bits of [D]
            needed[name := parent_name(array) + shape] = array
            written[id(subject)] = _with(subject, name)
        if (entries := _archive(subject)) is not None:
            if id(entries) not in named_entries:
                named_entries[id(entries)] = replace(entries, arrays=())
                named = dict(zip(entries.names, entries.arrays, strict=True))
                needed |= named
                origins_of |= {name: {} for name in named}
            written[id(subject)] = replace(written[id(subject)], archive=named_entries[id(entries)])
    arrays: dict[bytes, NDArray[Any]] = {}
    origins: dict[bytes, Origin] = {}
    for name, array in needed.items():
        if name in memory:
            continue
        steps = _steps(name, memory, origins_of.get(name, {})) if array.nbytes >= LEAST_BYTES else None
        if steps is None:
            arrays[name] = array
        else:
            origins |= steps
        for each in [name] if steps is None else steps:
            memory.add(each, array.nbytes)
    memory.needed(needed, origins_of)
    pickled = pickle.dumps([(written[id(subject)], chunk) for subject, chunk in work], pickle.HIGHEST_PROTOCOL)
    return Parcel(arrays, origins, pickled)


def _parameters(subject: Subject) -> Any:
    return subject.parameters_N_D if isinstance(subject, Policies) else subject.parameters_D


def _archive(subject: Subject) -> ArchiveEntries | None:
    return subject.archive if isinstance(subject, Centre) else None


def _with(subject: Subject, parameters: Any) -> Subject:
    """A subject with other parameters: a name stands for them in a message, and for parents those of their recipes."""
    return replace(subject, **{"parameters_N_D" if isinstance(subject, Policies) else "parameters_D": parameters})


def _steps(name: bytes, memory: Memory[int], origins: Mapping[bytes, Origin]) -> dict[bytes, Origin] | None:
    """The origins of policies to make one after another, the last of which is the one that is named; None if they are
    not known, or too many."""
    steps: dict[bytes, Origin] = {}
    waiting = [name]
    while waiting:
        policy_name = waiting.pop(0)
        if policy_name in memory:
            continue
        if (origin := origins.get(policy_name)) is None or (len(steps) == MOST_STEPS and policy_name not in steps):
            return None
        steps.pop(policy_name, None)  # what descends from it comes after it
        steps[policy_name] = origin
        waiting += origin.x, origin.y
    return dict(reversed(steps.items()))


class Received:
    """The arrays that a worker has been sent, or has made of others."""

    def __init__(self, most_bytes: int, made: Callable[[Recipes], FloatArray]) -> None:
        """Have nothing yet.

        Args:
            most_bytes: as in `Memory`.
            made: `Recipes.made`, or its equal in bits.
        """
        self.memory: Memory[NDArray[Any]] = Memory(most_bytes, attrgetter("nbytes"))
        self._made = made
        self._archive: ArchiveEntries | None = None
        """The newest entries of the novelty archive, whose tree serves until there are more."""

    def add(self, arrays: Mapping[bytes, NDArray[Any]]) -> None:
        """Take arrays, which come before the item that needs them."""
        for name, array in arrays.items():
            self.memory.add(name, array)

    def work(self, origins: Mapping[bytes, Origin], work: bytes) -> list[Work]:
        """A work item. Raises LackingError."""
        self._make(origins)
        item: list[Work] = pickle.loads(work)
        read: dict[int, Subject] = {}
        names: dict[bytes, None] = {}
        parents: set[bytes] = set()
        try:
            for subject in {id(subject): subject for subject, _ in item}.values():
                read[id(subject)] = subject
                if (recipes := recipes_in(subject)) is not None:
                    read[id(subject)] = _with(subject, recipes.complete(self.memory, {}))
                    names |= dict.fromkeys(recipes.names)
                    parents.update(recipes.names)
                elif isinstance(name := _parameters(subject), bytes):
                    read[id(subject)] = _with(subject, self.memory[name])
                    names[name] = None
                if (entries := _archive(subject)) is not None:
                    self._archive = entries.complete(self.memory, self._archive)
                    read[id(subject)] = replace(read[id(subject)], archive=self._archive)
                    names |= dict.fromkeys(entries.names)
                    parents.update(entries.names)
        except KeyError as error:
            raise LackingError from error
        self.memory.needed(names, parents)
        return [(read[id(subject)], chunk) for subject, chunk in item]

    def _make(self, origins: Mapping[bytes, Origin]) -> None:
        """Make policies again, those of one rule together as soon as their parents are there, since a call takes longer
        than a small policy. What cannot be made is lacking."""
        waiting, memory = dict(origins), self.memory
        while ready := [name for name, origin in waiting.items() if origin.x in memory and origin.y in memory]:
            together = [name for name in ready if waiting[name].rule == waiting[ready[0]].rule]
            made = self._made(recipes_again([waiting.pop(name) for name in together], memory))
            for name, parameters_D in zip(together, made, strict=True):
                memory.add(name, parameters_D.copy())  # an array of its own, so that it can be forgotten alone
        memory.use(origins)
