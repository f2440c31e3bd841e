"""A state as named arrays: what the store keeps, compares and hashes, made of any dataclasses by one pair of functions.

A state is a tree of dataclasses, mappings and tuples, whose leaves are arrays and numbers. Each dataclass and each
mapping is a *node*, known by its path, such as `centres/0/step`, with its leaves as arrays by name. A node all of whose
arrays have the same number of rows, on axis 0, is a table and is stored in blocks of rows; others are stored whole.
So what has grown is stored as its new rows, and what has changed in some rows as their blocks.
"""

from __future__ import annotations

import math
import types
from collections.abc import Iterator, Mapping
from dataclasses import Field, fields, is_dataclass
from functools import cache
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from es_service.loop.state import Changes, RunState
from es_service.protocol.content import NAME, NO_NAME, Arrays, as_bytes, names_in
from es_service.search.algorithms.base import SearchState, frozen
from es_service.search.arrays import same, same_rows

Tree = Mapping[str, Arrays]
"""Path of a node -> its arrays; or name of a stored block -> its arrays."""

COUNTS, BEST, OBSERVATIONS, WEIGHT, MAP, GEOMETRY, ARCHIVE, CENTRES, EXTRA = (
    "counts", "best", "observations", "weight", "map", "map/geometry", "archive", "centres", "extra",
)  # fmt: skip
"""Paths of nodes; those of centres are CENTRES and a number."""
BLOCK = "#"
"""Separates the path of a table and the number of a block of its rows."""
BLOCK_BYTES = 1 << 14
"""Most bytes of a block with more than one row."""
_NUMBERS: Mapping[Any, Any] = {int: np.int64, float: np.float64}


def centre_path(index: int) -> str:
    return f"{CENTRES}/{index}"


def tree_of(state: RunState) -> dict[str, Any]:
    """What is stored of a state besides its generation and its times, which are in the history."""
    counts = {"env_steps": state.env_steps, "episodes": state.episodes}
    return {**_children(state.search), OBSERVATIONS: state.observations, BEST: state.best, COUNTS: counts}


def stored(state: RunState) -> dict[str, Arrays]:
    return {name: arrays for name, arrays in changes(state, None)[0].items() if arrays is not None}


def changes(state: RunState, before: RunState | None) -> tuple[dict[str, Arrays | None], frozenset[bytes]]:
    """The blocks in which a state differs from the one before, None for those that it has not any more; and the names
    that it has where it differs, which another row may have had.

    Contents are compared, so that no change is lost, however it was made; only the same object is taken for unchanged,
    since its arrays are read-only.
    """
    differing: dict[str, Arrays | None] = {}
    found: set[bytes] = set()
    for path, owner, owner_then in _pairs(tree_of(state), None if before is None else tree_of(before), ""):
        now, then = _arrays(owner), _arrays(owner_then)
        _compare(path, now, then, differing)
        for name, array in (now or {}).items():
            if array.dtype == NAME:
                now_N, then_N = array.reshape(-1), (then or {}).get(name, np.zeros(0, NAME)).reshape(-1)
                both = min(now_N.size, then_N.size) if then_N.dtype == NAME else 0
                found |= {*as_bytes(now_N[:both][now_N[:both] != then_N[:both]]), *as_bytes(now_N[both:])}
    return differing, frozenset(found) - {NO_NAME}


def names_of(blocks: Changes) -> frozenset[bytes]:
    return frozenset[bytes]().union(*(names_in(arrays) for arrays in blocks.values() if arrays is not None))


def joined(blocks: Tree) -> dict[str, Arrays]:
    """The nodes whose blocks are given."""
    nodes: dict[str, Arrays] = {}
    tables: dict[str, dict[int, Arrays]] = {}
    for name, arrays in blocks.items():
        path, is_block, number = name.partition(BLOCK)
        if is_block:
            tables.setdefault(path, {})[int(number)] = arrays
        else:
            nodes[path] = arrays
    for path, numbered in tables.items():
        in_order = [numbered[number] for number in sorted(numbered)]
        nodes[path] = {name: np.concatenate([block[name] for block in in_order]) for name in in_order[0]}
    return nodes


def state_of(blocks: Tree, generation: int, wall_clock_s: float) -> RunState:
    """The state that consists of these blocks, or nodes; inverse of `stored`.

    Raises:
        ValueError: one is missing.
    """
    nodes = joined(blocks)
    hints, of_search, counts = _hints(RunState), _hints(SearchState), nodes.get(COUNTS, {})
    search = SearchState(
        **{field.name: value_of(of_search[field.name], nodes, field.name) for field in _fields(SearchState)}
    )
    return RunState(
        generation=generation,
        search=frozen(search),
        observations=value_of(hints[OBSERVATIONS], nodes, OBSERVATIONS),
        best=value_of(hints[BEST], nodes, BEST),
        env_steps=int(counts["env_steps"]),
        episodes=int(counts["episodes"]),
        wall_clock_s=wall_clock_s,
    )


def value_of(kind: Any, nodes: Tree, path: str) -> Any:
    """The value of a type that is at a path among nodes; None if it may be None and is not there.

    Raises:
        ValueError: it is missing.
    """
    options = get_args(kind) if get_origin(kind) in (Union, types.UnionType) else (kind,)
    for option in options:
        if (value := _value(option, nodes, path)) is not None:
            return value
    if type(None) in options:
        return None
    raise ValueError(f"the state has no {path}")


def _value(kind: Any, nodes: Tree, path: str) -> Any:
    """As `value_of` for a type without alternatives; None if it is not there."""
    node, _, name = path.rpartition("/")
    array, origin = nodes.get(node, {}).get(name), get_origin(kind)
    if is_dataclass(kind) and isinstance(kind, type):
        hints, needed = _hints(kind), [field.name for field in _fields(kind)]
        values = {name: _or_none(hints[name], nodes, f"{path}/{name}") for name in needed}
        absent = [name for name in needed if values[name] is None and type(None) not in get_args(hints[name])]
        return None if absent else kind(**values)
    if origin is tuple and is_dataclass(get_args(kind)[0]):
        members = []
        while (member := _value(get_args(kind)[0], nodes, f"{path}/{len(members)}")) is not None:
            members.append(member)
        return tuple(members)
    if origin is not None and issubclass(origin, Mapping):
        return _mapping(nodes, path)
    if array is None:
        return None
    if kind in (int, float, bool):
        return kind(array)
    return _tuples(array.tolist()) if origin is tuple else array


def _or_none(kind: Any, nodes: Tree, path: str) -> Any:
    try:
        return value_of(kind, nodes, path)
    except ValueError:
        return None


def _mapping(nodes: Tree, path: str) -> dict[str, Any]:
    """The mapping at a path, with those in it."""
    below = {other.removeprefix(f"{path}/").partition("/")[0] for other in nodes if other.startswith(f"{path}/")}
    return {**nodes.get(path, {}), **{name: _mapping(nodes, f"{path}/{name}") for name in sorted(below)}}


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


@cache
def _fields(kind: type) -> tuple[Field[Any], ...]:
    """The fields of a dataclass that are stored; others are derived from these."""
    return tuple(field for field in fields(kind) if not field.metadata.get("derived"))


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _children(owner: Any) -> Mapping[str, Any]:
    """What a dataclass or a mapping has, by name."""
    if isinstance(owner, Mapping):
        return owner
    return {field.name: getattr(owner, field.name) for field in _fields(type(owner))}


@cache
def _is_node(kind: type) -> bool:
    return issubclass(kind, Mapping) or is_dataclass(kind)


def _is_group(value: object) -> bool:
    """Whether a value is a tuple of nodes."""
    return isinstance(value, tuple) and bool(value) and _is_node(type(value[0]))


def _pairs(now: Any, then: Any, path: str) -> Iterator[tuple[str, Any, Any]]:
    """Path and owners of each node of two trees, but their roots, that is not the same object in both; None for one
    that is not there. What is the same object has the same nodes below."""
    children, earlier = (_children(owner) if owner is not None else {} for owner in (now, then))
    for name in [*children, *(earlier.keys() - children.keys())]:
        value, before = children.get(name), earlier.get(name)
        if value is before:
            continue
        at = f"{path}/{name}" if path else name
        members = {where: (node, None) for where, node in _members(at, value)}
        for where, node in _members(at, before):
            members[where] = members.get(where, (None, None))[0], node
        for where, (node, node_then) in members.items():
            if node is not node_then:
                yield where, node, node_then
                yield from _pairs(node, node_then, where)


def _members(path: str, value: Any) -> list[tuple[str, Any]]:
    """The nodes that a child is: itself, the members of a group, or none."""
    if _is_group(value):
        return [(f"{path}/{number}", member) for number, member in enumerate(value)]
    return [(path, value)] if _is_node(type(value)) else []


def _arrays(owner: Any) -> dict[str, np.ndarray] | None:
    """The leaves of a node as arrays; None for no node."""
    if owner is None:
        return None
    types_of = {} if isinstance(owner, Mapping) else _hints(type(owner))
    return {
        name: np.asarray(value, _NUMBERS.get(types_of.get(name)))
        for name, value in _children(owner).items()
        if value is not None and not _is_node(type(value)) and not _is_group(value)
    }


def _rows(arrays: Arrays | None) -> int | None:
    """Rows of a block of a table; None for a node that is none."""
    counts = {array.shape[:1] for array in (arrays or {}).values()}
    if len(counts) != 1 or () in counts:
        return None
    row_bytes = sum(array.dtype.itemsize * math.prod(array.shape[1:]) for array in (arrays or {}).values())
    return max(1, BLOCK_BYTES // max(1, row_bytes))


def _compare(path: str, now: Arrays | None, then: Arrays | None, differing: dict[str, Arrays | None]) -> None:
    """Add the blocks in which a node differs from what it was."""
    rows, rows_then = _rows(now), _rows(then)
    if rows is not None and rows == rows_then and _same_columns(now or {}, then or {}):
        _compare_rows(path, now or {}, then or {}, rows, differing)
    elif now is None or then is None or now.keys() != then.keys() or not _all_same(now, then):
        differing |= dict.fromkeys(_names(path, then)) | _blocks(path, now)


def _compare_rows(path: str, now: Arrays, then: Arrays, rows: int, differing: dict[str, Arrays | None]) -> None:
    count, count_then = (len(next(iter(arrays.values()))) for arrays in (now, then))
    is_other = np.ones(max(count, count_then), bool)
    is_other[: min(count, count_then)] = ~np.logical_and.reduce([same_rows(now[name], then[name]) for name in now])
    numbers = np.unique(np.flatnonzero(is_other) // rows).tolist()
    first_empty = len(_names(path, now))
    differing |= {
        f"{path}{BLOCK}{number:06d}": None if number >= first_empty else _block(now, number, rows) for number in numbers
    }


def _same_columns(now: Arrays, then: Arrays) -> bool:
    def columns(arrays: Arrays) -> dict[str, Any]:
        return {name: (array.dtype, array.shape[1:]) for name, array in arrays.items()}

    return columns(now) == columns(then)


def _all_same(now: Arrays, then: Arrays) -> bool:
    # Small arrays first: of a centre that has moved, a count says so.
    return all(same(now[name], then[name]) for name in sorted(now, key=lambda name: now[name].size))


def _block(arrays: Arrays, number: int, rows: int) -> Arrays:
    return {name: array[number * rows : (number + 1) * rows] for name, array in arrays.items()}


def _names(path: str, arrays: Arrays | None) -> list[str]:
    """Names of the blocks of a node; a table without rows has one, too."""
    if arrays is None:
        return []
    if (rows := _rows(arrays)) is None:
        return [path]
    count = len(next(iter(arrays.values())))
    return [f"{path}{BLOCK}{number:06d}" for number in range(max(1, -(-count // rows)))]


def _blocks(path: str, arrays: Arrays | None) -> dict[str, Arrays]:
    if arrays is None or (rows := _rows(arrays)) is None:
        return {} if arrays is None else {path: arrays}
    return {name: _block(arrays, number, rows) for number, name in enumerate(_names(path, arrays))}
