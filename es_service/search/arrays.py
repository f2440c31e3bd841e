"""Arrays of a state that nobody changes, and the comparison of their bits.

A search of the user's own may remember more than centres, novelty archive and map. `Algorithm.extra` declares it, by
name, with its initial values, and `SearchState.extra` has the present ones: NumPy arrays, and mappings of such values,
also nested ones. The store compares contents, so every change is stored: values, types and shapes, and names that come
and go. If all arrays of a mapping have the same number of rows, only the blocks of rows that differ are stored. An
array of the type `protocol.content.NAME` names policies, which are stored as long as it does. Values are read-only; to
change one, return a state with another mapping:

    replace(state, extra={**state.extra, "tries": {**state.extra["tries"], str(cell): count}})
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.content import NAME

_NUMERIC_KINDS = "biufc"
_RESERVED = "/#"
"""Characters of the names of stored arrays, which no name of a search may have."""


class ReadOnly(Mapping[str, Any]):
    def __init__(self, content: Mapping[str, Any]) -> None:
        self._content = dict(content)

    def __getitem__(self, key: str) -> Any:
        return self._content[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._content)

    def __len__(self) -> int:
        return len(self._content)

    def __repr__(self) -> str:
        return repr(self._content)


def freeze(values: Iterable[Any]) -> None:
    """Make arrays read-only, with the arrays of which they are views."""
    for value in values:
        while isinstance(value, np.ndarray):  # a NumPy scalar is read-only; whatever else there is, `problem` refuses
            value.flags.writeable = False
            value = value.base


def read_only(extra: Mapping[str, Any]) -> Mapping[str, Any]:
    """The same values, with arrays made read-only, in read-only mappings; itself if it is such a mapping."""
    if isinstance(extra, ReadOnly):
        return extra
    # A resumed run has arrays in C order; in another one, sums of the same values may have other bits.
    ordered: dict[str, Any] = {}
    for name, value in extra.items():
        if isinstance(value, Mapping):
            ordered[name] = read_only(value)
        else:
            is_unordered = isinstance(value, np.ndarray) and not value.flags.c_contiguous
            ordered[name] = np.array(value, order="C") if is_unordered else value
    freeze(ordered.values())
    return ReadOnly(ordered)


def problem(extra: Mapping[str, Any], before: object = None) -> str:
    """Why values cannot be stored; empty if they can.

    Args:
        before: values that can be; mappings that are the same objects are not looked at again.
    """
    then = before if isinstance(before, Mapping) else {}
    for name, value in extra.items():
        if not isinstance(name, str) or not name or any(character in name for character in _RESERVED):
            return f"the name {name!r} of a value of its own is no text without '/' and '#'"
        if isinstance(value, Mapping):
            if value is not then.get(name) and (wrong := problem(value, then.get(name))):
                return wrong
        elif not _is_array(value):
            return (
                f"its own value {name!r} is {_kind(value)}; it must be a NumPy array of bools, numbers or names, or a "
                "mapping of such"
            )
    return ""


def same(now: np.ndarray, then: np.ndarray) -> bool:
    """Whether two arrays have the same type, shape and bits."""
    if now is then:  # both are read-only
        return True
    return now.dtype == then.dtype and now.shape == then.shape and bool((_bits(now) == _bits(then)).all())


def same_rows(now: np.ndarray, then: np.ndarray) -> NDArray[np.bool_]:
    """Whether each of the first rows that two arrays both have is the same, bit for bit, [rows]."""
    count = min(len(now), len(then))
    if now.dtype != then.dtype or now.shape[1:] != then.shape[1:]:
        return np.zeros(count, bool)
    if _address(now) == _address(then) and now.strides == then.strides:  # an archive that has grown
        return np.ones(count, bool)
    row_bytes = now.dtype.itemsize * math.prod(now.shape[1:])
    word = np.dtype(f"u{math.gcd(row_bytes, 8)}")
    first, second = (np.frombuffer(array[:count].tobytes(), word) for array in (now, then))
    return (first == second).reshape(count, row_bytes // word.itemsize).all(axis=1)


def _address(array: np.ndarray) -> int:
    return array.__array_interface__["data"][0]


def _bits(values: np.ndarray) -> np.ndarray:
    """An array as unsigned integers of the same bits: NaN then equals itself, and 0 differs from -0."""
    unsigned = {1: np.uint8, 2: np.uint16, 4: np.uint32, 8: np.uint64}.get(values.dtype.itemsize)
    return values.view(unsigned) if unsigned else np.frombuffer(values.tobytes(), np.uint8)


def _is_array(value: object) -> bool:
    is_array = isinstance(value, np.ndarray | np.generic)
    return is_array and (value.dtype.kind in _NUMERIC_KINDS or value.dtype == NAME)


def _kind(value: object) -> str:
    return f"an array of {value.dtype}" if isinstance(value, np.ndarray) else f"a {type(value).__name__}"
