"""Cells of a map: a regular grid, the Voronoi cells of evenly spread centroids, or slots that have no place.

Descriptors outside the bounds belong to a cell at the border. All computation is in float64 and written so that equal
descriptors fall into the same cell on every machine. The positions of a cvt's centroids may depend on the machine, so
they are stored with the run. Axes: N descriptors or places, B descriptor dimensions, C centroids.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from es_service.config.map_rules import LLOYD_STEPS, PLACES_PER_CENTROID
from es_service.protocol.messages import Bounds, TaskSpec
from es_service.protocol.noise import Domain, stream_keys, uniforms

if TYPE_CHECKING:
    from es_service.config.sections import MapConfig

LATTICE_PER_CELL = 8
"""Number of places along each side of a cell that are tested to find out whether the cell can be reached."""
MOST_LATTICE_POINTS = 2_000_000
OUTER_LATTICE = 100
KMEANS_CHANGE = 1e-4
"""SciPy's k-means ends when a step changes the mean distance of a place by less."""
CENTROID_STREAM = 2**32
"""Last id of the random stream of Domain.INITIALISATION that places centroids; no centre has this id."""


@dataclass(frozen=True)
class Grid:
    """A regular grid. Cells are numbered in row-major order: the last descriptor dimension changes fastest."""

    bounds: Bounds
    shape: tuple[int, ...]
    """Cells along each dimension."""

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    @cached_property
    def edges(self) -> tuple[NDArray[np.float64], ...]:
        """Edges of cells along each dimension: edge i is low + i * (high - low) / cells; the last is exactly high."""
        return tuple(
            np.array([*(low + i * (high - low) / cells for i in range(cells)), high])
            for (low, high), cells in zip(self.bounds, self.shape, strict=True)
        )

    def cells_of(self, descriptor_N_B: ArrayLike) -> NDArray[np.int64]:
        """Cell of each finite descriptor, [N].

        Along each dimension, cell i reaches from edge i (included) to edge i + 1 (excluded); the last cell includes its
        upper edge. A descriptor outside the bounds belongs to the border cell.
        """
        descriptor_N_B = np.asarray(descriptor_N_B, np.float64)
        cell_N = np.zeros(len(descriptor_N_B), np.int64)
        for b, (edges, cells) in enumerate(zip(self.edges, self.shape, strict=True)):
            cell_N = cell_N * cells + np.searchsorted(edges[1:-1], descriptor_N_B[:, b], side="right")
        return cell_N

    def middles_of(self, cell_N: NDArray[np.int64]) -> NDArray[np.float64]:
        """Descriptor in the middle of each cell, [N, B]."""
        places = np.unravel_index(cell_N, self.shape)
        return np.stack(
            [0.5 * (edges[place_N] + edges[place_N + 1]) for edges, place_N in zip(self.edges, places, strict=True)],
            axis=1,
        )

    def index_of(self, cell: int) -> tuple[int, ...]:
        """Index of a cell along each dimension, as users write it: `--cell 3,17`."""
        return tuple(int(i) for i in np.unravel_index(cell, self.shape))

    def cell_at(self, index: tuple[int, ...]) -> int | None:
        """Inverse of `index_of`; None if there is no such cell."""
        if len(index) != len(self.shape) or not all(0 <= i < n for i, n in zip(index, self.shape, strict=True)):
            return None
        return int(np.ravel_multi_index(index, self.shape))


@dataclass(frozen=True)
class Cvt:
    """Cells around centroids that are spread evenly: a centroidal Voronoi tessellation (Vassiliades et al. 2018).

    Distances are measured in units of high - low of each dimension, so that all dimensions count equally.
    """

    bounds: Bounds
    centroid_C_B: NDArray[np.float64]

    @property
    def size(self) -> int:
        return len(self.centroid_C_B)

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of cells, as for a grid with one dimension."""
        return (self.size,)

    def cells_of(self, descriptor_N_B: ArrayLike) -> NDArray[np.int64]:
        """Index of the centroid nearest to each descriptor, [N]; of equally near ones the first."""
        descriptor_N_B = np.asarray(descriptor_N_B, np.float64)
        cell_N = np.zeros(len(descriptor_N_B), np.int64)
        block = max(1, 2**20 // self.size)
        for start in range(0, len(descriptor_N_B), block):
            rows = slice(start, start + block)
            squared = np.zeros((len(descriptor_N_B[rows]), self.size))
            for b in range(self.centroid_C_B.shape[1]):
                low, high = self.bounds[b]
                difference = (descriptor_N_B[rows, None, b] - self.centroid_C_B[None, :, b]) / (high - low)
                squared += difference * difference
            cell_N[rows] = squared.argmin(axis=1)
        return cell_N

    def middles_of(self, cell_N: NDArray[np.int64]) -> NDArray[np.float64]:
        """Centroid of each cell, [N, B]."""
        return self.centroid_C_B[cell_N]

    def index_of(self, cell: int) -> tuple[int, ...]:
        """The cell's number, as an index with one element."""
        return (cell,)

    def cell_at(self, index: tuple[int, ...]) -> int | None:
        """Inverse of `index_of`; None if there is no such cell."""
        return index[0] if len(index) == 1 and 0 <= index[0] < self.size else None


@dataclass(frozen=True)
class Dominated:
    """Slots without a place, whose elites hold out against fitter ones nearby: `maps/dominated.py` says which stay.

    A grid, which has no effect on them, only counts which part of the descriptor space they cover.
    """

    bounds: Bounds
    grid_shape: tuple[int, ...]
    """Cells of that grid along each dimension."""
    slots: int
    """Number of elites at most."""
    neighbours: int
    """Number of fitter elites from which a distance is measured."""

    @property
    def size(self) -> int:
        return self.slots

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of slots, as for a grid with one dimension."""
        return (self.slots,)

    def index_of(self, cell: int) -> tuple[int, ...]:
        """The slot's number, as an index with one element."""
        return (cell,)

    def cell_at(self, index: tuple[int, ...]) -> int | None:
        """Inverse of `index_of`; None if there is no such slot."""
        return index[0] if len(index) == 1 and 0 <= index[0] < self.slots else None


Tessellation = Grid | Cvt
Geometry = Grid | Cvt | Dominated


def tessellation(geometry: Geometry) -> Tessellation:
    """The cells of the descriptor space by which coverage is counted: those of the map or, of slots, their grid."""
    return Grid(geometry.bounds, geometry.grid_shape) if isinstance(geometry, Dominated) else geometry


def intervals(geometry: Tessellation) -> NDArray[np.float64]:
    """(low, high) of each cell of a map of one dimension, [C, 2]."""
    if isinstance(geometry, Grid):
        edges = geometry.edges[0]
        return np.stack([edges[:-1], edges[1:]], axis=1)
    place_C, (low, high) = geometry.centroid_C_B[:, 0], geometry.bounds[0]
    order = np.argsort(place_C, kind="stable")
    edges = np.concatenate([[low], (place_C[order][:-1] + place_C[order][1:]) / 2, [high]])
    return np.stack([edges[:-1], edges[1:]], axis=1)[np.argsort(order)]


def cell_count(config: MapConfig) -> int:
    return math.prod(config.cells)


def make_geometry(config: MapConfig) -> Geometry:
    """The cells that a config specifies; they are the same for every seed, so that runs can be compared by cell."""
    if config.kind == "grid":
        return Grid(config.bounds, config.cells)
    if config.kind == "dominated":
        return Dominated(config.bounds, config.cells, config.slots, config.neighbours)
    return Cvt(config.bounds, _centroids(config.bounds, config.cells[0], config.centroids))


def reachable_cells(geometry: Tessellation, task: TaskSpec) -> NDArray[np.bool_] | None:
    """Whether each cell contains a place where an episode can end, [cells]; None if this is unknown.

    A place cannot be reached if it is nearer to the middle of a wall than `task.wall_clearance`, or outside the task's
    own bounds. The result is None if the task does not specify its walls, if the descriptor does not have two
    dimensions, if there are more than two million cells, or if no cell could be reached.
    """
    if task.walls is None or len(geometry.bounds) != 2 or geometry.size > MOST_LATTICE_POINTS:
        return None
    per_cell = min(LATTICE_PER_CELL, int(math.sqrt(MOST_LATTICE_POINTS / geometry.size)))
    shape = geometry.shape if isinstance(geometry, Grid) else (math.isqrt(geometry.size) + 1,) * 2
    # Each cell of a grid gets the same number of places, so that none is missed. The second lattice covers the task's
    # bounds, because places outside the map's bounds belong to its border cells.
    place_N_2 = np.concatenate(
        [
            _lattice(geometry.bounds, (per_cell * shape[0], per_cell * shape[1])),
            _lattice(task.descriptor_bounds, (OUTER_LATTICE, OUTER_LATTICE)),
        ]
    )
    low_2, high_2 = np.array(task.descriptor_bounds).T
    free_N = ((place_N_2 >= low_2) & (place_N_2 <= high_2)).all(axis=1)
    for start, end in task.walls:
        start_2, way_2 = np.array(start), np.array(end) - np.array(start)
        along_N = np.clip((place_N_2 - start_2) @ way_2 / (way_2 @ way_2), 0.0, 1.0)
        gap_N_2 = place_N_2 - start_2 - along_N[:, None] * way_2
        free_N &= (gap_N_2**2).sum(axis=1) >= task.wall_clearance**2
    reachable = np.zeros(geometry.size, bool)
    reachable[geometry.cells_of(place_N_2[free_N])] = True
    return reachable if reachable.any() else None


def _lattice(bounds: Bounds, counts: tuple[int, int]) -> NDArray[np.float64]:
    """Midpoints of equal rectangles that fill a region of the plane, [counts[0] * counts[1], 2]."""
    axes = [
        low + (np.arange(count) + 0.5) / count * (high - low) for count, (low, high) in zip(counts, bounds, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)


@cache
def _centroids(bounds: Bounds, count: int, how: str) -> NDArray[np.float64]:
    """Evenly spread centroids, [C, B]: `map.centroids` on random places, started from the first `count` of them."""
    from scipy.cluster.vq import kmeans, kmeans2  # imported late: it takes 0.1 s, and most runs do not need it

    low_B, high_B = np.array(bounds, np.float64).T
    samples = PLACES_PER_CENTROID[how] * count
    key = stream_keys(0, Domain.INITIALISATION, 0, CENTROID_STREAM)
    share: Any = uniforms(key, np.arange(samples * len(bounds), dtype=np.uint32))
    place_N_B = share.astype(np.float64).reshape(samples, len(bounds))
    if how == "lloyd":
        centroid_C_B, _ = kmeans2(place_N_B, place_N_B[:count], iter=LLOYD_STEPS, minit="matrix")
    else:
        centroid_C_B, _ = kmeans(place_N_B, place_N_B[:count], thresh=KMEANS_CHANGE)
        lost = count - len(centroid_C_B)  # those to which no place was nearest
        centroid_C_B = np.concatenate([centroid_C_B, place_N_B[count : count + lost]])
    centroid_C_B = low_B + centroid_C_B * (high_B - low_B)
    centroid_C_B.flags.writeable = False
    return centroid_C_B
