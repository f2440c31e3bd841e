"""Policies that are evaluated as they are, without noise in parameters or actions: explicit ones, whose parameters
travel, and recipes, by which they are made where they are evaluated, of parents and of noise that has an address.

The parameters of a policy that descends from others need not travel: whoever has its parents makes it, with the same
bits everywhere. Parents are known by their content, and each is sent to a worker once (`sent.py`). Such et al. 2017
(arXiv:1712.06567) encode individuals by the seeds of their noise in this spirit.

Axes: N policies that travel together, L slots of a chunk, D policy parameters, O observation.
"""

from __future__ import annotations

import hashlib
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.content import NAME, as_bytes
from es_service.protocol.noise import KEY_WORDS, Domain, Keys, normals

FloatArray = NDArray[np.float32]
NAME_BYTES = 16
"""Bytes of a parent's name: the first half of the SHA-256 of its parameters."""
TOGETHER = 8
"""Policies that are made together. Those of a small network stay in the cache of a core."""
LARGEST_NOISE = 8.0
"""Bound of the magnitude of a normal variate of `protocol.noise`."""
LARGEST_FLOAT = float(np.finfo(np.float32).max)
POLICY_SLOTS = 16
"""Slots of a policy chunk, each of which is one episode of one policy. This is a constant so that the shape that is
compiled never changes."""
ALL_TOGETHER = 1 << 62
"""Number of policies that a worker with several cores is sent as one chunk, which it takes apart: any."""
POLICIES_TOGETHER = 8 * POLICY_SLOTS
"""Most slots in one call of a kernel: a call costs little then, and the memory of the weights stays small."""


class IsoLine(NamedTuple):
    """The iso+line variation of two parents x and y (Vassiliades and Mouret 2018, arXiv:1804.03906):

    x + iso_sigma * a + line_sigma * b * (y - x)

    a has a standard normal variate for each parameter, b is a single one.
    """

    iso_sigma: float
    line_sigma: float


Variation = Callable[[FloatArray, FloatArray, Keys, IsoLine], FloatArray]
"""Function with the arguments and the result of `variation`."""


def variation(x: FloatArray, y: FloatArray, keys: Keys, rule: IsoLine) -> FloatArray:
    """The iso+line variation of each x [..., D], whose line goes through its y, with noise of a stream for each.

    This is the definition: each operation is rounded to float32, and none are fused.

    Args:
        keys: of the streams [..., 4]; their coordinates 0 to D - 1 are those of the parameters, coordinate D is that of
            the line.
    """
    noise = normals(keys, x.shape[-1] + 1)
    iso, line = np.float32(rule.iso_sigma) * noise[..., :-1], np.float32(rule.line_sigma) * noise[..., -1:]
    iso += x
    iso += line * (y - x)
    return iso


class Origin(NamedTuple):
    """How one policy was made, so that it can be made again wherever its parents are."""

    rule: IsoLine
    x: bytes
    y: bytes
    """Names of its parents."""
    key_4: Keys


@dataclass(frozen=True, eq=False)
class Recipes:
    """How policies are made, each of two parents."""

    rule: IsoLine
    names: tuple[bytes, ...]
    """Names of the parents, each of which occurs once."""
    parents: tuple[FloatArray, ...]
    """Their parameters; empty where they are known by their names: in an ask."""
    parent_N_2: NDArray[np.int64]
    """Indices of each policy's parents x and y among the names."""
    key_N_4: Keys
    """Key of the stream of each policy's noise."""
    origins: Mapping[bytes, Origin] = field(default_factory=dict, repr=False)
    """How parents, and policies of which they were made, were made themselves, as far as it is known; it never travels
    with the recipes (`protocol.sent`)."""

    def __reduce__(self) -> tuple[Any, ...]:
        return Recipes, (self.rule, self.names, self.parents, self.parent_N_2, self.key_N_4)

    def __len__(self) -> int:
        return len(self.parent_N_2)

    def part(self, of: slice | Sequence[int]) -> Recipes:
        """The recipes of some of the policies, with the parents that these need."""
        used, parent_M_2 = np.unique(self.parent_N_2[of], return_inverse=True)
        names, parents = (tuple(all_[index] for index in used.tolist()) for all_ in (self.names, self.parents))
        key_M_4 = self.key_N_4[of]
        return replace(self, names=names, parents=parents, parent_N_2=parent_M_2.reshape(-1, 2), key_N_4=key_M_4)

    def some(self, of: slice) -> Recipes:
        """The recipes of some of the policies, still with the parents of all."""
        return Recipes(self.rule, self.names, self.parents, self.parent_N_2[of], self.key_N_4[of], self.origins)

    def complete(self, known: Mapping[bytes, FloatArray], origins: Mapping[bytes, Origin]) -> Recipes:
        """The recipes with the parents' parameters, which are taken from others by their names, and with origins."""
        return replace(self, parents=tuple(known[name] for name in self.names), origins=origins)

    def origins_of(self, names: Sequence[bytes]) -> dict[bytes, Origin]:
        """How these policies are made, by their names, so that they need not travel if they become parents."""
        origins = {
            name: Origin(self.rule, self.names[x], self.names[y], key_4.copy())
            for (x, y), key_4, name in zip(self.parent_N_2.tolist(), self.key_N_4, names, strict=True)
        }
        # A policy as it is says nothing of how it was made.
        return {name: origin for name, origin in origins.items() if name not in (origin.x, origin.y)}

    def made(self, vary: Variation = variation) -> FloatArray:
        """The parameters of the policies, [N, D].

        Args:
            vary: `variation`, or what has its bits.
        """
        policy_N_D = np.empty((len(self), self.parents[0].size), np.float32)
        for first in range(0, len(self), TOGETHER):
            part = slice(first, first + TOGETHER)
            x_M_D, y_M_D = (np.stack([self.parents[index] for index in of]) for of in self.parent_N_2[part].T.tolist())
            policy_N_D[part] = vary(x_M_D, y_M_D, self.key_N_4[part], self.rule)
        return policy_N_D

    def problem(self, parameters: int) -> str:
        """In which way these are no recipes of finite policies with some number of parameters; empty if they are."""
        count = len(self.parent_N_2)
        facts = [*map(_facts, self.parents)]
        for form in dict.fromkeys(parent_facts.form for parent_facts in facts):
            if form != f"float32 ({parameters},)":
                return f"have a parent that is {form}; must be float32 ({parameters},)"
        indices = self.parent_N_2
        if not count or indices.shape != (count, 2) or indices.dtype.kind != "i":
            return f"have parents {indices.dtype} {indices.shape}; must be indices of shape (policies, 2)"
        if indices.min() < 0 or indices.max() >= len(self.parents):
            return f"have a parent {indices.min()} or {indices.max()}; there are {len(self.parents)}"
        if self.key_N_4.dtype != np.uint32 or self.key_N_4.shape != (count, KEY_WORDS):
            return f"have keys {self.key_N_4.dtype} {self.key_N_4.shape}; must be uint32 ({count}, {KEY_WORDS})"
        if not all(0.0 <= sigma < np.inf for sigma in self.rule):
            return f"have the standard deviations {tuple(self.rule)}; must be finite and not negative"
        iso, line = (LARGEST_NOISE * sigma for sigma in self.rule)
        largest = float(np.max([parent_facts.largest for parent_facts in facts]))
        # No difference of parents may overflow either. NaN is not less than anything.
        if not (1.0 + 2.0 * max(1.0, line)) * largest + iso < LARGEST_FLOAT:
            return f"make policies that may not be finite, of parents with values up to {largest:g}"
        return ""


def explicit(policies: Sequence[FloatArray | Recipes]) -> FloatArray:
    """The parameters of policies, [N, D], some of which are made of recipes."""
    return np.concatenate([group.made() if isinstance(group, Recipes) else group for group in policies])


def recipes_again(origins: Sequence[Origin], parents: Mapping[bytes, FloatArray]) -> Recipes:
    """The recipes of policies by their origins, all of which have the same rule."""
    index = {
        name: at for at, name in enumerate(dict.fromkeys(name for origin in origins for name in (origin.x, origin.y)))
    }
    parent_N_2 = np.array([(index[origin.x], index[origin.y]) for origin in origins])
    key_N_4 = np.stack([origin.key_4 for origin in origins])
    return Recipes(origins[0].rule, tuple(index), tuple(parents[name] for name in index), parent_N_2, key_N_4)


def recipes_of(
    rule: IsoLine, parents: Sequence[FloatArray] | NDArray[Any], parent_N_2: NDArray[np.int64], key_N_4: Keys
) -> Recipes:
    """Recipes of parents that are given by their parameters, [D] each, or by an array of their names.

    Args:
        parent_N_2: indices of each policy's parents x and y.
        key_N_4: key of the stream of each policy's noise.

    Raises:
        TypeError: a parent is no array.
    """
    if isinstance(parents, np.ndarray) and parents.dtype == NAME:
        return Recipes(rule, tuple(as_bytes(parents)), (), parent_N_2, key_N_4)
    return Recipes(rule, tuple(map(parent_name, parents)), tuple(parents), parent_N_2, key_N_4)


def unvaried(policies: Sequence[FloatArray] | NDArray[Any]) -> Recipes:
    """Recipes of policies as they are, given as to `recipes_of`; workers may know them already as parents of others."""
    itself_N_2 = np.repeat(np.arange(len(policies))[:, None], 2, axis=1)
    return recipes_of(IsoLine(0.0, 0.0), policies, itself_N_2, np.zeros((len(policies), KEY_WORDS), np.uint32))


def parent_name(parameters_D: FloatArray) -> bytes:
    """Name of a policy by its content.

    Raises:
        TypeError: it is no array.
    """
    return _facts(parameters_D).name


class _Facts(NamedTuple):
    """What is known of an array."""

    of: weakref.ref[FloatArray]
    name: bytes
    form: str
    """Its type and shape."""
    largest: float
    """Largest magnitude; NaN if a value is NaN."""


_KNOWN: dict[int, _Facts] = {}
"""Facts by the `id` of an array that cannot change, while it lives; the same elites are parents again and again."""


def _facts(parameters_D: FloatArray) -> _Facts:
    number = id(parameters_D)
    if (known := _KNOWN.get(number)) is not None and known.of() is parameters_D:
        return known
    if not isinstance(parameters_D, np.ndarray):
        raise TypeError(f"a parent is {type(parameters_D).__name__}; must be a float32 array [D]")
    values = np.ascontiguousarray(parameters_D)
    name = hashlib.sha256(values.data).digest()[:NAME_BYTES]
    largest = float(np.abs(values).max(initial=0.0))
    form = f"{parameters_D.dtype} {parameters_D.shape}"
    facts = _Facts(weakref.ref(parameters_D, lambda _: _KNOWN.pop(number, None)), name, form, largest)
    if _cannot_change(parameters_D):
        _KNOWN[number] = facts
    return facts


def _cannot_change(array: FloatArray) -> bool:
    """Whether an array is read-only, and so is the memory of which it is a view."""
    memory: object = array
    while isinstance(memory, np.ndarray):
        if memory.flags.writeable:
            return False
        memory = memory.base
    return memory is None or isinstance(memory, bytes)


@dataclass(frozen=True)
class Policies:
    """Policies that travel together, once to each worker that runs chunks of them: up to POLICY_SLOTS, or those of
    several chunks that are sent as one."""

    first: int
    """Number of the first of them among the policies of their ask."""
    episodes: int
    seed: int
    """Seed of the resets. In a run it is the seed of the run."""
    traces: bool
    """Whether the results have the trace of the first episode of each policy."""
    parameters_N_D: NDArray[np.float32] | Recipes
    """Parameters of each policy, or recipes by which they are made."""
    observation_mean_N_O: NDArray[np.float32] | None = None
    observation_std_N_O: NDArray[np.float32] | None = None
    """Observation statistics of each policy; None stands for 0 and 1."""
    domain: Domain = Domain.EVALUATION_RESET
    """Purpose of the episodes, which is part of the addresses of their resets."""


@dataclass(frozen=True)
class PolicyChunk:
    """Request to roll out the policies that it is sent with, from slot `POLICY_SLOTS * part` on.

    Slots count the policies first: slot s is episode s // N of policy s % N, so that one episode of each wastes
    nothing. The last chunk may have fewer slots. The reset of an episode is addressed by seed, generation, episode,
    number of the policy and ask, so neither the chunk nor the number of policies has an influence on it.
    """

    generation: int
    chunk_id: int
    """Number of the chunk among those of its ask."""
    ask: int = 0
    """Index of the policies' ask among those of its generation that are for policies."""
    part: int = 0
    """Number of the chunk among those of the policies that it is sent with."""
    first: int = 0
    count: int = POLICY_SLOTS
    """First wanted slot and number of wanted slots, if this is a piece of a chunk, or several chunks in one
    (`protocol.episodes`)."""
    request: int = 0
    """As of a training chunk."""


def chunks_of(policies: int, episodes: int) -> int:
    """Number of chunks of policies that travel together."""
    return -(-policies * episodes // POLICY_SLOTS)


def slots(policies: Policies, chunk: PolicyChunk) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """(index of the policy [L], number of the episode [L]) of each slot of a chunk."""
    count, first = len(policies.parameters_N_D), chunk.part * POLICY_SLOTS + chunk.first
    slot_L = np.arange(first, min(first + chunk.count, count * policies.episodes))
    return slot_L % count, slot_L // count
