"""A k-d tree over entries of a novelty archive, which proposes the nearest ones.

Axes: N entries, K those of them that are in the tree, B descriptor dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
