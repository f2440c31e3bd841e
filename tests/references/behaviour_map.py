"""The behaviour map once more, for reading: one descriptor at a time, a dict from cell to elite."""

import math
from dataclasses import dataclass
from typing import Any


def grid_index(bounds, shape, descriptor):
    """Place along each dimension, found by walking up the edges; on an edge the upper cell, the last edge excepted."""
    index = []
    for (low, high), cells, value in zip(bounds, shape, descriptor, strict=True):
        place = 0
        while place + 1 < cells and value >= low + (place + 1) * (high - low) / cells:
            place += 1
        index.append(place)
    return tuple(index)


def cell_number(shape, index):
    """Cells counted with the last dimension running fastest."""
    number = 0
    for cells, place in zip(shape, index, strict=True):
        number = number * cells + place
    return number


def nearest_centroid(centroids, descriptor):
    """Index of the nearest centroid; of equally near ones the first."""
    nearest, least = None, math.inf
    for index, centroid in enumerate(centroids):
        square = 0.0
        for x, c in zip(descriptor, centroid, strict=True):
            square += (float(x) - float(c)) * (float(x) - float(c))
        if square < least:
            nearest, least = index, square
    return nearest


@dataclass
class Elite:
    fitness: float
    descriptor: Any
    generation: int
    score: float
    """Highest fitness in the population that led to it or, later, that it led; NaN without one."""
    centre: Any = None
    emitter: int = 0


class GridMap:
    """`elites` is in the order in which cells were filled: a dict keeps the place of a key whose value changes."""

    def __init__(self, bounds, shape):
        self.bounds, self.shape, self.elites = bounds, shape, {}

    def insert(self, elite):
        """The index of the cell that the elite entered; None if it did not."""
        index = grid_index(self.bounds, self.shape, elite.descriptor)
        if index in self.elites and elite.fitness <= self.elites[index].fitness:
            return None
        self.elites[index] = elite
        return index

    def offer(self, elites):
        """Insert elites one after another: of each, the cell of which it is the elite then, or None."""
        for elite in elites:
            self.insert(elite)
        return [next((cell for cell, other in self.elites.items() if other is one), None) for one in elites]


def coverage(elites, cells):
    return len(elites) / cells


def qd_score(elites, offset):
    total = 0.0
    for elite in elites.values():
        total += elite.fitness - offset
    return total
