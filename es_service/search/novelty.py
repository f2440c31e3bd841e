"""Novelty: mean distance of a descriptor to its nearest entries of the novelty archive.

Source: Conti et al. 2018 (arXiv:1712.06560). With our searches the novelty archive only grows: it gets one entry for
each valid evaluated centre, in order. `protocol/nearest.py` computes the distances, here or where the members are.

Axes: N entries of the novelty archive, Q queries, B descriptor dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from es_service.protocol.machine import usable_cpus
from es_service.protocol.nearest import Distance, Tree, make_tree, mean_distances

TREE_STEP = 256
"""Least number of entries between two trees. Entries after the newest tree are compared one by one."""
LEAST_ROOM = 256
"""Least capacity of an archive's arrays, in entries."""


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
    threads: int | None = None,
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
        threads: most threads among which the queries are divided; None: one for each core of this machine, since the
            workers wait while a search computes novelties.

    Returns:
        float64, with the leading axes of the queries.
    """
    shape = np.shape(descriptor_Q_B)[:-1]
    query_Q_B = np.asarray(descriptor_Q_B, np.float64).reshape(-1, archive.descriptor_N_B.shape[1])
    excluded_Q = np.full(len(query_Q_B), -1) if exclude_Q is None else np.asarray(exclude_Q)
    if newest is not None and newest < archive.size:
        excluded_Q = np.maximum(excluded_Q - (archive.size - newest), -1)
        archive = _newest(archive, newest)
    entries = archive.descriptor_N_B, archive.tree
    novelty_Q = mean_distances(*entries, query_Q_B, excluded_Q, neighbours, distance, threads or usable_cpus())
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
