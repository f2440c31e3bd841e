"""Several policies in each cell of a behaviour map, with values that may fall: the container under noise.

An elite is the best of many noisy evaluations, so part of its fitness, and of its place, is luck. Here a cell keeps up
to `depth` policies. They are measured again, and each is where the mean (or the median) of all its samples says. The
map itself, which everything else reads, is the top layer: of each cell the fittest policy.

Sources: Flageat et al. 2025 (Extract-QD, arXiv:2502.06585), whose container this is, with Archive-Sampling and explicit
averaging (both in Flageat and Cully 2023, arXiv:2302.00463) and Deep-Grid (Flageat and Cully 2020, "Fast and stable
MAP-Elites in noisy domains using deep grids") as special cases. All functions are pure and work on whole batches.

Axes: K kept policies, Q policies that are put in, R policies that are measured again, B descriptor dimensions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.content import NAME
from es_service.search.maps.behaviour_map import BehaviourMap
from es_service.search.maps.geometry import Tessellation

Draw = Literal["exponential", "linear", "harmonic", "uniform"]
Replace = Literal["worst", "any"]


@dataclass(frozen=True)
class KeptPolicies:
    """Values of all kept policies, by cell and, within a cell, by rank: the fittest first, the older of equal ones."""

    serial_K: NDArray[np.int64]
    """A number for each policy, greater than those of all older ones that are kept with it."""
    cell_K: NDArray[np.int64]
    fitness_K: NDArray[np.float64]
    """Mean, or median, of the fitness over all samples."""
    descriptor_K_B: NDArray[np.float64]
    """The same of the descriptor, whose cell is that of the policy."""
    samples_K: NDArray[np.int64]
    """Number of samples. Each is the mean of `search.evaluation_episodes` episodes."""
    generation_K: NDArray[np.int64]
    centre_K: NDArray[np.int64]
    """Generation and index of the centre or policy with which each was first evaluated: see `BehaviourMap`."""
    score_K: NDArray[np.float64]
    """See `BehaviourMap.score_N`."""
    policy_K: NDArray[Any]
    trace_K: NDArray[Any]
    """Names of each policy and of its trace."""

    @property
    def size(self) -> int:
        return self.serial_K.size

    @property
    def ranks(self) -> NDArray[np.int64]:
        """Rank of each policy in its cell, 0 for the fittest, [K]."""
        return _positions(self.cell_K)

    @property
    def top_rows(self) -> NDArray[np.int64]:
        """Indices on axis K of the fittest policy of each filled cell, by cell."""
        return np.flatnonzero(self.ranks == 0)


COLUMNS = tuple(field.name for field in fields(KeptPolicies))


def empty_kept(dimensions: int) -> KeptPolicies:
    """No policies, with descriptors of some number of dimensions."""
    whole, real, name = np.zeros(0, np.int64), np.zeros(0), np.zeros(0, NAME)
    return KeptPolicies(whole, whole, real, np.zeros((0, dimensions)), whole, whole, whole, real, name, name)


def kept_to_arrays(kept: KeptPolicies) -> dict[str, NDArray[Any]]:
    return {name: getattr(kept, name) for name in COLUMNS}


def kept_from_arrays(arrays: Mapping[str, NDArray[Any]]) -> KeptPolicies:
    """Inverse of `kept_to_arrays`; other arrays are ignored."""
    return KeptPolicies(**{name: arrays[name] for name in COLUMNS})


def at_rows(kept: KeptPolicies, rows: NDArray[Any]) -> KeptPolicies:
    """Some of the policies: indices on axis K, or whether each is taken."""
    return KeptPolicies(**{name: values[rows] for name, values in kept_to_arrays(kept).items()})


def drawn_again(kept: KeptPolicies, count: int, draw: Draw, uniform_K: NDArray[np.floating]) -> NDArray[np.int64]:
    """Indices of `count` different policies, all if there are fewer, in increasing order.

    They are drawn without replacement, with probabilities in proportion to a weight that depends on the rank alone:
    exponential: exp(-rank). linear: the deepest rank + 1 - rank. harmonic: 1 / (rank + 1). uniform: the same for all.

    Args:
        uniform_K: uniform random numbers in [0, 1).
    """
    if count >= kept.size:
        return np.arange(kept.size)
    rank_K = kept.ranks.astype(np.float64)
    weight_K = {
        "exponential": np.exp(-rank_K),
        "linear": rank_K.max(initial=0.0) + 1.0 - rank_K,
        "harmonic": 1.0 / (rank_K + 1.0),
        "uniform": np.ones(kept.size),
    }[draw]
    # The first `count` of independent exponential waiting times with these rates: Efraimidis and Spirakis 2006.
    waiting_K = -np.log1p(-np.asarray(uniform_K, np.float64)) / weight_K
    return np.sort(np.argsort(waiting_K, kind="stable")[:count])


def with_values(
    kept: KeptPolicies,
    rows: NDArray[np.int64],
    fitness_R: NDArray[np.float64],
    descriptor_R_B: NDArray[np.float64],
) -> KeptPolicies:
    """The policies with one more sample in some rows, and with these values there. Cells stay as they are until `put`.

    Args:
        rows: indices on axis K, each once.
    """
    samples_K, fitness_K, descriptor_K_B = (
        column.copy() for column in (kept.samples_K, kept.fitness_K, kept.descriptor_K_B)
    )
    samples_K[rows] += 1
    fitness_K[rows], descriptor_K_B[rows] = fitness_R, descriptor_R_B
    return replace(kept, samples_K=samples_K, fitness_K=fitness_K, descriptor_K_B=descriptor_K_B)


def with_means(
    kept: KeptPolicies,
    rows: NDArray[np.int64],
    fitness_R: NDArray[np.float64],
    descriptor_R_B: NDArray[np.float64],
) -> KeptPolicies:
    """As `with_values`, with the means of all samples, of which the given ones are the newest."""
    count_R, fitness_was_R, descriptor_was_R_B = (
        column[rows] for column in (kept.samples_K, kept.fitness_K, kept.descriptor_K_B)
    )
    return with_values(
        kept,
        rows,
        fitness_was_R + (fitness_R - fitness_was_R) / (count_R + 1),
        descriptor_was_R_B + (descriptor_R_B - descriptor_was_R_B) / (count_R + 1)[:, None],
    )


def put(
    resident: KeptPolicies,
    coming: KeptPolicies,
    geometry: Tessellation,
    depth: int,
    how: Replace = "worst",
    uniform_K: NDArray[np.floating] | None = None,
) -> KeptPolicies:
    """All policies in the cells of their descriptors, of which each keeps at most `depth`.

    worst: a cell keeps its fittest policies; of equally fit ones the older. any: a policy that comes takes a free place
    or, in a full cell, that of a random resident, whatever its fitness; of more than `depth` policies that come into a
    cell, the first ones stay.

    Args:
        resident: policies whose cells are known.
        coming: policies whose cells are those of their descriptors: new ones, and those that were measured again.
        uniform_K: for `any`, a uniform random number in [0, 1) for each resident.
    """
    coming = replace(coming, cell_K=geometry.cells_of(coming.descriptor_K_B))
    both = KeptPolicies(**{name: np.concatenate([getattr(resident, name), getattr(coming, name)]) for name in COLUMNS})
    if how == "any" and uniform_K is not None:
        turn_K = np.concatenate([np.asarray(uniform_K, np.float64), np.full(coming.size, -1.0)])
        order = np.lexsort((both.serial_K, turn_K, both.cell_K))
        both = at_rows(both, order[_positions(both.cell_K[order]) < depth])
    both = at_rows(both, np.lexsort((both.serial_K, -both.fitness_K, both.cell_K)))
    return at_rows(both, _positions(both.cell_K) < depth)


def top_layer(kept: KeptPolicies, before: BehaviourMap) -> BehaviourMap:
    """The map whose elites are the fittest policies of the cells.

    Cells that were filled before keep their place in the order of filling. The others follow in the order of the
    numbers of their policies.
    """
    top = at_rows(kept, kept.top_rows)
    rows = np.searchsorted(top.cell_K, before.cell_N)
    stays_N = np.append(top.cell_K, -1)[rows] == before.cell_N
    is_new = ~np.isin(top.cell_K, before.cell_N)
    new_rows = np.flatnonzero(is_new)[np.argsort(top.serial_K[is_new], kind="stable")]
    in_order = at_rows(top, np.concatenate([rows[stays_N], new_rows]))
    return BehaviourMap(
        before.geometry,
        in_order.cell_K,
        in_order.fitness_K,
        in_order.descriptor_K_B,
        in_order.generation_K,
        in_order.centre_K,
        in_order.score_K,
        in_order.policy_K,
        in_order.trace_K,
        in_order.samples_K,
    )


def _positions(sorted_K: NDArray[np.int64]) -> NDArray[np.int64]:
    """Position of each element among the equal ones, which stand side by side: 0, 1, 2 ... for each value."""
    index_K = np.arange(sorted_K.size)
    first_K = np.concatenate([np.ones(min(1, sorted_K.size), bool), sorted_K[1:] != sorted_K[:-1]])
    return index_K - np.maximum.accumulate(np.where(first_K, index_K, 0))
