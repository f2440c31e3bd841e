"""Arrays by the name of their content: the SHA-256 of their bits. Policies and traces are stored once under their name,
and a `Cache` has the newest of what is known by name.

What refers to them is an array of names, whose type is `NAME`, so that everybody who has the arrays of a state can see
which contents it names.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cache, lru_cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.policy_spec import PolicySpec

Arrays = Mapping[str, NDArray[Any]]
"""Name of an array -> the array."""
Contents = Mapping[bytes, Arrays]
"""Name of a content -> its arrays."""
NAME = np.dtype("V32")
"""Type of an array of names: the bytes of a SHA-256 each."""
Key = TypeVar("Key")
Value = TypeVar("Value")
NO_NAME = bytes(NAME.itemsize)
"""Stands for no name in an array of names."""


def name_of(arrays: Arrays) -> bytes:
    """Name of a content: SHA-256 of the name, type, shape and little-endian values of each array, sorted by name."""
    total = hashlib.sha256()
    for name in sorted(arrays):
        little = np.asarray(arrays[name])
        little = np.ascontiguousarray(little, little.dtype.newbyteorder("<")).reshape(little.shape)
        total.update(_heading(name, little.dtype.str, little.shape))
        total.update(little.tobytes() if little.dtype == NAME or not little.size else little.data)
    return total.digest()


@lru_cache
def _heading(name: str, dtype: str, shape: tuple[int, ...]) -> bytes:
    return json.dumps([name, dtype, list(shape)]).encode() + b"\n"


def names(values: Iterable[bytes]) -> NDArray[Any]:
    return np.frombuffer(b"".join(values), NAME)


def names_in(arrays: Arrays) -> frozenset[bytes]:
    found = [name for array in arrays.values() if array.dtype == NAME for name in as_bytes(array)]
    return frozenset(found) - {NO_NAME}


def as_bytes(name_N: NDArray[Any]) -> list[bytes]:
    return name_N.reshape(-1).tolist()


@dataclass(frozen=True, eq=False)
class Policy:
    """A policy with the observation statistics that it runs with: one form, from the map of a search to an export.

    Axes: D policy parameters, O observation.
    """

    spec: PolicySpec
    parameters_D: NDArray[np.float32] = field(repr=False)
    observation_mean_O: NDArray[np.float32] = field(repr=False)
    observation_std_O: NDArray[np.float32] = field(repr=False)

    @property
    def content(self) -> dict[str, NDArray[Any]]:
        """Its arrays as they are stored, and named."""
        return {name: getattr(self, name) for name in OF_POLICY} | {"spec": _text_of(self.spec)}

    @property
    def name(self) -> bytes:
        """Its name; two policies are the same if their names are equal."""
        return name_of(self.content)


@cache
def _text_of(spec: PolicySpec) -> NDArray[np.uint8]:
    return np.frombuffer(json.dumps(asdict(spec), sort_keys=True).encode(), np.uint8)


OF_POLICY = ("parameters_D", "observation_mean_O", "observation_std_O")
"""Arrays of a policy; a content that has them is one."""


def policy_of(spec: PolicySpec, content: Arrays) -> Policy:
    """The policy of a content. Raises KeyError if it is none."""
    return Policy(spec, *(content[name] for name in OF_POLICY))


class Cache(dict[Key, Value]):
    """Values by key, in the order in which they were added or used, and the sum of their sizes.

    Only the methods here may change it: those of `dict` do not count bytes.
    """

    def __init__(self, size_of: Callable[[Value], int]) -> None:
        """Have nothing yet; `size_of`: bytes of a value."""
        super().__init__()
        self._size_of = size_of
        self.nbytes = 0
        """Bytes of all values."""

    def add(self, key: Key, value: Value) -> None:
        """Take a value as the newest, in the place of the one that had this key."""
        self.forget(key)
        self[key] = value
        self.nbytes += self._size_of(value)

    def use(self, keys: Iterable[Key]) -> None:
        """Make those that are here the newest."""
        for key in keys:
            if key in self:
                self[key] = self.pop(key)

    def forget(self, key: Key) -> None:
        if key in self:
            self.nbytes -= self._size_of(self.pop(key))

    def forget_oldest(self, most_bytes: int, spared: Collection[Key] = ()) -> None:
        """Forget the oldest until at most so many bytes remain, or the oldest is a spared one."""
        while self.nbytes > most_bytes and (oldest := next(iter(self))) not in spared:
            self.forget(oldest)

    def clear(self) -> None:
        super().clear()
        self.nbytes = 0
