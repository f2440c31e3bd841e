"""Novelty: mean distance of a descriptor to its nearest entries of the novelty archive.

Source: Conti et al. 2018 (arXiv:1712.06560). With our searches the novelty archive only grows: it gets one entry for
each valid evaluated centre, in order. In a large archive a k-d tree proposes the candidates, but distances are always
computed by the same float64 expression, so the tree does not change any bit of the result.

Axes: N entries of the novelty archive, Q queries, K nearest candidates or entries in the tree, B descriptor dimensions.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from es_service.protocol.machine import usable_cpus

if TYPE_CHECKING:
    from scipy.spatial import KDTree


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


Distance = Literal["euclidean", "squared_euclidean"]

TREE_STEP = 256
"""Least number of entries between two trees. Entries after the newest tree are compared one by one."""
LEAST_ROOM = 256
"""Least capacity of an archive's arrays, in entries."""
SPARE_CANDIDATES = 6
"""Additional neighbours that are requested from the tree, so that an effect of its rounding can be noticed."""
BLOCK = 1024
"""Queries that are compared at a time, since more distances would leave the core's cache. While a run computes
novelties, its workers wait, so each core takes a block. No query depends on another."""
TREE_ROUNDING = 1e-9
"""Generous bound on the relative difference between the tree's distances and ours."""


@dataclass
class _Room:
    """Arrays with spare capacity, which archives of successive generations share.

    An entry is written once, after all others. Archives that consist of the first entries of the same room therefore
    never change, and a generation does not copy earlier entries.
    """

    descriptor_B: NDArray[np.float64]
    generation: NDArray[np.int64]
    centre: NDArray[np.int64]
    used: int
    """Number of entries written so far."""

    @property
    def is_writeable(self) -> bool:
        """Whether there can be more; a search may have made a view of these arrays read-only, and them with it."""
        return all(array.flags.writeable for array in (self.descriptor_B, self.generation, self.centre))


@dataclass(frozen=True)
class NoveltyArchive:
    """Descriptors of the valid centres evaluated so far, in order. It is immutable: `extended` returns a new one."""

    descriptor_N_B: NDArray[np.float64]
    generation_N: NDArray[np.int64]
    """Generation in which each was evaluated; 0 for initial centres."""
    centre_N: NDArray[np.int64]
    """Index of the centre that made each entry."""
    tree: Tree | None = field(default=None, metadata={"derived": True})
    """A tree over the first entries, derived from `descriptor_N_B`; None for a small archive."""
    room: _Room | None = field(default=None, metadata={"derived": True})
    """Storage of which the arrays are the first part; None if they are their own storage."""
    newest: dict[int, NoveltyArchive] = field(
        default_factory=dict, repr=False, compare=False, metadata={"derived": True}
    )
    """Archives of only its newest entries, by their number; derived, and made when one is first needed."""

    @property
    def size(self) -> int:
        return self.generation_N.size


def empty_archive(dimensions: int) -> NoveltyArchive:
    """A novelty archive without entries, in which every novelty is 0."""
    return NoveltyArchive(np.zeros((0, dimensions)), np.zeros(0, np.int64), np.zeros(0, np.int64))


def archive_of(
    descriptor_N_B: NDArray[np.float64], generation_N: NDArray[np.int64], centre_N: NDArray[np.int64]
) -> NoveltyArchive:
    """A novelty archive of existing entries, in the order given."""
    return _with_tree(_Room(descriptor_N_B, generation_N, centre_N, generation_N.size), None)


def extended(archive: NoveltyArchive, descriptor_B: ArrayLike, generation: int, centre: int) -> NoveltyArchive:
    """The archive with one more entry, the last; the given archive does not change.

    Raises:
        ValueError: the descriptor has another shape than those of the archive.
    """
    size, room = archive.size, archive.room
    if np.shape(descriptor_B) != archive.descriptor_N_B.shape[1:]:
        shapes = f"{np.shape(descriptor_B)}, but those of the archive have {archive.descriptor_N_B.shape[1:]}"
        raise ValueError(f"the descriptor has shape {shapes}")
    if room is None or room.used != size or room.used == room.generation.size or not room.is_writeable:
        room = _copied(archive)
    room.descriptor_B[size], room.generation[size], room.centre[size] = descriptor_B, generation, centre
    room.used = size + 1
    return _with_tree(room, archive.tree)


def sound_archive(archive: NoveltyArchive) -> NoveltyArchive:
    """The archive itself if this module has made it; else one of the same entries, with a tree over these.

    Raises:
        ValueError: it has not as many descriptors, generations and centres.
    """
    if archive.room is not None and (archive.tree is None or archive.tree.entries <= archive.size):
        in_room = (archive.room.descriptor_B, archive.room.generation, archive.room.centre)
        pairs = list(zip(in_room, _columns(archive), strict=True))
        are_first = all(_address(ours) == _address(it) and ours.strides == it.strides for ours, it in pairs)
        if are_first and all(len(it) == archive.size for _, it in pairs):
            return archive
    columns = [np.array(given, kind, order="C") for given, kind in zip(_columns(archive), "dqq", strict=True)]
    if columns[0].ndim != 2 or any(len(given) != len(columns[0]) for given in columns):
        raise ValueError(f"the arrays of the novelty archive have the shapes {[given.shape for given in columns]}")
    return archive_of(*columns)


def novelty(
    archive: NoveltyArchive,
    descriptor_Q_B: ArrayLike,
    *,
    neighbours: int,
    distance: Distance,
    newest: int | None = None,
    exclude_Q: ArrayLike | None = None,
) -> NDArray[np.float64]:
    """Mean distance of each query to its `neighbours` nearest entries, or to all entries if there are fewer.

    Distances are computed in float64, sorted in ascending order and added in this order. A query without any neighbour
    has novelty 0; a query that is not finite has novelty NaN.

    Args:
        descriptor_Q_B: descriptors of the queries, with any number of leading axes.
        neighbours: `novelty.neighbours`, k in the paper.
        distance: euclidean, in units of the descriptor, or squared_euclidean, the mean of squared distances in squared
            units, as in the released ME-ES code.
        newest: number of the newest entries that count; None for all.
        exclude_Q: index of an entry that each query ignores, usually its own, or -1 for none; only for queries with one
            leading axis.

    Returns:
        float64, with the leading axes of the queries.
    """
    shape = np.shape(descriptor_Q_B)[:-1]
    query_Q_B = np.asarray(descriptor_Q_B, np.float64).reshape(-1, archive.descriptor_N_B.shape[1])
    excluded_Q = np.full(len(query_Q_B), -1) if exclude_Q is None else np.asarray(exclude_Q)
    if newest is not None and newest < archive.size:
        excluded_Q = np.maximum(excluded_Q - (archive.size - newest), -1)
        archive = _newest(archive, newest)
    finite_Q = np.atleast_1d(np.isfinite(query_Q_B).all(axis=1))
    novelty_Q = np.full(len(query_Q_B), np.nan)

    def fill(first: int) -> None:
        rows = first + np.flatnonzero(finite_Q[first : first + BLOCK])
        novelty_Q[rows] = _mean_nearest(archive, query_Q_B[rows], excluded_Q[rows], neighbours, distance)

    blocks = range(0, len(query_Q_B), BLOCK)
    threads = min(len(blocks), usable_cpus())
    if threads > 1:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(fill, blocks))
    else:
        for first in blocks:
            fill(first)
    return novelty_Q.reshape(shape)


def _columns(archive: NoveltyArchive) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return archive.descriptor_N_B, archive.generation_N, archive.centre_N


def _address(values: np.ndarray) -> int:
    return np.asarray(values).__array_interface__["data"][0]


def _copied(archive: NoveltyArchive) -> _Room:
    """A new room with a copy of an archive's entries and capacity for as many again."""
    size = archive.size
    capacity = max(2 * size, LEAST_ROOM)
    room = _Room(
        np.empty((capacity, archive.descriptor_N_B.shape[1])), np.empty(capacity, int), np.empty(capacity, int), size
    )
    room.descriptor_B[:size], room.generation[:size] = archive.descriptor_N_B, archive.generation_N
    room.centre[:size] = archive.centre_N
    return room


def _with_tree(room: _Room, tree: Tree | None) -> NoveltyArchive:
    """The archive of all entries in a room, with a tree over the entries up to a multiple of a step.

    `tree` is used if it covers just those entries; otherwise a new tree is built. The more entries a tree has, the
    longer it takes to build, so the step grows with them: it is a power of two near sqrt(size), at least TREE_STEP.
    """
    descriptor_N_B = room.descriptor_B[: room.used]
    step = max(TREE_STEP, 1 << room.used.bit_length() // 2)
    covered = room.used // step * step
    if covered and (tree is None or tree.entries != covered):
        tree = make_tree(descriptor_N_B[:covered])
    return NoveltyArchive(descriptor_N_B, room.generation[: room.used], room.centre[: room.used], tree, room)


def _newest(archive: NoveltyArchive, count: int) -> NoveltyArchive:
    """The archive of only the newest entries, of which there are fewer than in all."""
    if count not in archive.newest:  # a generation asks for it once for each of its populations
        last = slice(archive.size - count, None)
        archive.newest[count] = archive_of(
            archive.descriptor_N_B[last], archive.generation_N[last], archive.centre_N[last]
        )
    return archive.newest[count]


def _mean_nearest(
    archive: NoveltyArchive,
    query_Q_B: NDArray[np.float64],
    excluded_Q: NDArray[np.int64],
    neighbours: int,
    distance: Distance,
) -> NDArray[np.float64]:
    """Mean distance of finite queries to their nearest entries, [Q]; from the tree's candidates if these suffice."""
    tree = archive.tree
    asked = neighbours + 1 + SPARE_CANDIDATES  # + 1 in case the excluded entry is among them
    if tree is None or asked >= tree.kd.n or (tree.entry_K is not None and asked > COPIES):
        return mean_smallest(_squared(archive, query_Q_B, excluded_Q), neighbours, distance)
    reach_Q_K, point_Q_K = tree.kd.query(query_Q_B, asked)
    candidate_Q_K = tree.entries_of(point_Q_K)
    near_Q_K = squared_to(query_Q_B, archive.descriptor_N_B[candidate_Q_K])
    near_Q_K[candidate_Q_K == excluded_Q[:, None]] = np.inf
    tail_Q_N = _squared(archive, query_Q_B, excluded_Q, tree.entries)
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
        near_1_K = squared_to(query_Q_B[single], archive.descriptor_N_B[None, within])
        near_1_K[:, within == excluded_Q[index]] = np.inf
        mean_Q[single] = mean_smallest(np.concatenate([near_1_K, tail_Q_N[single]], axis=1), neighbours, distance)
    return mean_Q


def _squared(
    archive: NoveltyArchive, query_Q_B: NDArray[np.float64], excluded_Q: NDArray[np.int64], first: int = 0
) -> NDArray[np.float64]:
    """Squared distances [Q, N - first] to the entries from `first` on, infinite for the excluded entry."""
    squared_Q_N = squared_to(query_Q_B, archive.descriptor_N_B[None, first:])
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
