"""Mean distances to nearest entries, of which novelty is made: the same bits wherever they are computed.

In a large archive a k-d tree proposes the candidates, but distances are always computed by the same float64 expression,
so the tree does not change any bit of the result.

Axes: N entries of the novelty archive, Q queries, K nearest candidates or entries in the tree, B descriptor dimensions.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from scipy.spatial import KDTree

Distance = Literal["euclidean", "squared_euclidean"]
NOVELTY = "novelty"
"""Output of the members of a population: the novelty of each, float64, if its centre has the archive for it."""
COPIES = 64
"""Largest number of entries with equal descriptors in a tree. Policies that do not move, or that end in a corner,
produce many such entries, and each query near them would visit them all."""


@dataclass(frozen=True)
class Tree:
    """A k-d tree over the first entries of an archive."""

    kd: KDTree
    entries: int
    """Number of those entries."""
    entry_K: NDArray[np.int64] | None
    """Indices of the entries that are in the tree; None for all of them."""

    def entries_of(self, points: ArrayLike) -> NDArray[np.int64]:
        """Indices of the entries for points of the tree."""
        return np.asarray(points) if self.entry_K is None else self.entry_K[np.asarray(points)]


def make_tree(descriptor_N_B: NDArray[np.float64]) -> Tree:
    """A tree over all entries, with at most the first COPIES of those with equal descriptors."""
    from scipy.spatial import KDTree  # imported late: it takes 0.25 s, and most runs do not need it

    size = len(descriptor_N_B)
    word_N = np.zeros(size, np.uint64)
    for b in range(descriptor_N_B.shape[1]):  # equal descriptors give equal hashes, others almost never
        word_N = word_N * np.uint64(0x9E3779B97F4A7C15) + np.ascontiguousarray(descriptor_N_B[:, b]).view(np.uint64)
    sorted_N = np.sort(word_N)
    if not (sorted_N[COPIES:] == sorted_N[:-COPIES]).any():
        return Tree(KDTree(descriptor_N_B), size, None)
    order_N = np.lexsort(descriptor_N_B.T)
    equal_N = (descriptor_N_B[order_N[COPIES:]] == descriptor_N_B[order_N[:-COPIES]]).all(axis=1)
    entry_K = np.sort(np.concatenate([order_N[:COPIES], order_N[COPIES:][~equal_N]]))
    return Tree(KDTree(descriptor_N_B[entry_K]), size, entry_K)


SPARE_CANDIDATES = 6
"""Additional neighbours that are requested from the tree, so that an effect of its rounding can be noticed."""
BLOCK = 1024
"""Queries that are compared at a time, since more distances would leave the core's cache."""
ROWS = 256
"""Entries in each array in which an archive travels. Full ones never change, so a worker gets each of them once."""
TREE_ROUNDING = 1e-9
"""Generous bound on the relative difference between the tree's distances and ours."""


@dataclass(frozen=True, eq=False)
class ArchiveEntries:
    """The entries of the novelty archive that count, and how novelty is computed, on their way to workers."""

    neighbours: int
    distance: Distance
    first: int
    """Number of entries of the first array that do not count."""
    size: int
    """Number of entries that count: those after them."""
    names: tuple[bytes, ...]
    """Names of the arrays in which they travel."""
    arrays: tuple[NDArray[np.float64], ...]
    """Their descriptors, ROWS in each array but the last; empty where they are known by name."""
    known_tree: Tree | None = field(default=None, repr=False)
    """A tree over those in full arrays, if there is one; it never travels."""

    def __reduce__(self) -> tuple[Any, ...]:
        return ArchiveEntries, (self.neighbours, self.distance, self.first, self.size, self.names, self.arrays)

    def complete(self, known: Mapping[bytes, NDArray[np.float64]], before: ArchiveEntries | None) -> ArchiveEntries:
        """The entries with their arrays, which are taken from others by name, and with a tree.

        Args:
            before: complete entries, such as those of the last generation, whose tree may still be right.
        """
        if before is not None and self.__reduce__()[1][:5] == before.__reduce__()[1][:5]:
            return before
        tree = before.tree if before is not None and self._in_full_arrays == before._in_full_arrays else None
        whole = replace(self, arrays=tuple(known[name] for name in self.names), known_tree=tree)
        _ = whole.tree  # made now, by the thread that takes a message, and not by each of those that compute
        return whole

    @cached_property
    def descriptors(self) -> NDArray[np.float64]:
        """Descriptors of those that count, [N, B]."""
        return np.concatenate(self.arrays)[self.first :]

    @cached_property
    def tree(self) -> Tree | None:
        """A tree over the entries in full arrays; None if there is no full one."""
        full = len(self._in_full_arrays[1])
        return self.known_tree or (make_tree(self.descriptors[: full * ROWS - self.first]) if full else None)

    @property
    def _in_full_arrays(self) -> tuple[int, tuple[bytes, ...]]:
        return self.first, self.names[: (self.first + self.size) // ROWS]

    def novelty(self, descriptor: ArrayLike) -> NDArray[np.float64]:
        """Novelty of each descriptor on the last axis, as the driver computes it."""
        query_Q_B = np.asarray(descriptor, np.float64)
        shape = query_Q_B.shape[:-1]
        query_Q_B = query_Q_B.reshape(-1, query_Q_B.shape[-1])
        nobody_Q = np.full(len(query_Q_B), -1)
        return mean_distances(self.descriptors, self.tree, query_Q_B, nobody_Q, self.neighbours, self.distance).reshape(
            shape
        )


def archive_entries(
    descriptor_N_B: NDArray[np.float64], newest: int | None, neighbours: int, distance: Distance
) -> ArchiveEntries:
    """Entries for workers, of all descriptors of an archive.

    Args:
        newest: number of the newest ones that count; None for all.
    """
    skipped = 0 if newest is None else max(0, len(descriptor_N_B) - newest)
    begin = skipped // ROWS * ROWS
    arrays = tuple(descriptor_N_B[start : start + ROWS] for start in range(begin, len(descriptor_N_B), ROWS))
    names = tuple(hashlib.sha256(repr(array.shape).encode() + array.tobytes()).digest() for array in arrays)
    return ArchiveEntries(neighbours, distance, skipped - begin, len(descriptor_N_B) - skipped, names, arrays)


def mean_distances(
    descriptor_N_B: NDArray[np.float64],
    tree: Tree | None,
    query_Q_B: NDArray[np.float64],
    excluded_Q: NDArray[np.int64],
    neighbours: int,
    distance: Distance,
    threads: int = 1,
) -> NDArray[np.float64]:
    """Mean distance of each query to its nearest entries, [Q]; NaN for a query that is not finite.

    Args:
        tree: over the first entries; None for none.
        excluded_Q: index of an entry that each query ignores, or -1.
        threads: most threads among which the queries are divided. No query depends on another.
    """
    finite_Q = np.atleast_1d(np.isfinite(query_Q_B).all(axis=1))
    mean_Q = np.full(len(query_Q_B), np.nan)

    def fill(first: int) -> None:
        rows = first + np.flatnonzero(finite_Q[first : first + BLOCK])
        mean_Q[rows] = mean_nearest(descriptor_N_B, tree, query_Q_B[rows], excluded_Q[rows], neighbours, distance)

    blocks = range(0, len(query_Q_B), BLOCK)
    if min(len(blocks), threads) > 1:
        with ThreadPoolExecutor(min(len(blocks), threads)) as pool:
            list(pool.map(fill, blocks))
    else:
        for first in blocks:
            fill(first)
    return mean_Q


def mean_nearest(
    descriptor_N_B: NDArray[np.float64],
    tree: Tree | None,
    query_Q_B: NDArray[np.float64],
    excluded_Q: NDArray[np.int64],
    neighbours: int,
    distance: Distance,
) -> NDArray[np.float64]:
    """Mean distance of finite queries to their nearest entries, [Q]; from the tree's candidates if these suffice."""
    asked = neighbours + 1 + SPARE_CANDIDATES  # + 1 in case the excluded entry is among them
    if tree is None or asked >= tree.kd.n or (tree.entry_K is not None and asked > COPIES):
        return mean_smallest(_squared(descriptor_N_B, query_Q_B, excluded_Q), neighbours, distance)
    reach_Q_K, point_Q_K = tree.kd.query(query_Q_B, asked)
    candidate_Q_K = tree.entries_of(point_Q_K)
    near_Q_K = squared_to(query_Q_B, descriptor_N_B[candidate_Q_K])
    near_Q_K[candidate_Q_K == excluded_Q[:, None]] = np.inf
    tail_Q_N = _squared(descriptor_N_B, query_Q_B, excluded_Q, tree.entries)
    squared_Q_K = _smallest(near_Q_K, neighbours)
    newer = np.flatnonzero((tail_Q_N < squared_Q_K[:, -1:]).any(axis=1))  # an entry after the tree is among the nearest
    squared_Q_K[newer] = _smallest(np.concatenate([squared_Q_K[newer], tail_Q_N[newer]], axis=1), neighbours)
    # A result is sure unless an entry that the tree did not return could, with rounding, be among the nearest.
    sure_Q = np.sqrt(squared_Q_K[:, -1]) <= reach_Q_K[:, -1] * (1.0 - TREE_ROUNDING)
    mean_Q = mean_smallest(squared_Q_K, neighbours, distance)
    for index in np.flatnonzero(~sure_Q):  # such as many entries at equal distance, where episodes end at a border
        single = slice(index, index + 1)
        radius = reach_Q_K[index, -1] * (1.0 + TREE_ROUNDING)
        within = tree.entries_of(tree.kd.query_ball_point(query_Q_B[index], radius))
        near_1_K = squared_to(query_Q_B[single], descriptor_N_B[None, within])
        near_1_K[:, within == excluded_Q[index]] = np.inf
        mean_Q[single] = mean_smallest(np.concatenate([near_1_K, tail_Q_N[single]], axis=1), neighbours, distance)
    return mean_Q


def _squared(
    descriptor_N_B: NDArray[np.float64],
    query_Q_B: NDArray[np.float64],
    excluded_Q: NDArray[np.int64],
    first: int = 0,
) -> NDArray[np.float64]:
    """Squared distances [Q, N - first] to the entries from `first` on, infinite for the excluded entry."""
    squared_Q_N = squared_to(query_Q_B, descriptor_N_B[None, first:])
    rows = np.flatnonzero(excluded_Q >= first)
    squared_Q_N[rows, excluded_Q[rows] - first] = np.inf
    return squared_Q_N


def squared_to(query_Q_B: NDArray[np.float64], entry_Q_N_B: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squared distances [Q, N], (x0 - y0)^2 + (x1 - y1)^2 + ... in this order; the only place that computes them."""
    total_Q_N = np.zeros(np.broadcast_shapes((len(query_Q_B), 1), entry_Q_N_B.shape[:2]))
    squared_Q_N = np.empty_like(total_Q_N)
    for b in range(query_Q_B.shape[1]):
        np.subtract(query_Q_B[:, None, b], entry_Q_N_B[..., b], out=squared_Q_N)
        total_Q_N += np.multiply(squared_Q_N, squared_Q_N, out=squared_Q_N)
    return total_Q_N


def _smallest(squared_Q_N: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """The `count` smallest values of each row in ascending order; all values if a row has fewer."""
    if count < squared_Q_N.shape[1]:
        squared_Q_N = np.partition(squared_Q_N, count - 1, axis=1)[:, :count]
    return np.sort(squared_Q_N, axis=1)


def mean_smallest(squared_Q_N: NDArray[np.float64], count: int, distance: Distance) -> NDArray[np.float64]:
    """Mean of the `count` smallest finite distances of each row, [Q]; 0 for a row without any."""
    squared_Q_K = _smallest(squared_Q_N, count)
    distance_Q_K = np.sqrt(squared_Q_K) if distance == "euclidean" else squared_Q_K
    there_Q_K = np.isfinite(distance_Q_K)
    total_Q = np.zeros(len(squared_Q_K))
    for k in range(distance_Q_K.shape[1]):  # added one by one, since np.sum may use another order
        total_Q += np.where(there_Q_K[:, k], distance_Q_K[:, k], 0.0)
    return total_Q / np.maximum(there_Q_K.sum(axis=1), 1)
