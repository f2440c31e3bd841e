"""MAP-Elites whose elites are measured again, once more: one policy at a time, each with a list of all its samples."""

import math
from dataclasses import dataclass, field
from statistics import fmean, median

from tests.references.behaviour_map import cell_number, grid_index

WEIGHTS = {
    "exponential": lambda rank, deepest: math.exp(-rank),
    "linear": lambda rank, deepest: deepest + 1 - rank,
    "harmonic": lambda rank, deepest: 1 / (rank + 1),
    "uniform": lambda rank, deepest: 1,
}


@dataclass
class Policy:
    serial: int
    generation: int
    number: int
    parameters: list
    samples: list = field(default_factory=list)
    """(fitness, descriptor) of each."""
    cell: int = -1


class MeasuredMapElites:
    def __init__(self, bounds, shape, depth, draw, estimate, replaces):
        self.bounds, self.shape, self.depth, self.draw, self.replaces = bounds, shape, depth, draw, replaces
        self.middle = {"mean": fmean, "median": median}[estimate]
        self.cells, self.filled, self.serial = {}, [], 0

    def fitness(self, policy):
        return self.middle([fitness for fitness, _ in policy.samples])

    def place(self, policy):
        columns = zip(*(descriptor for _, descriptor in policy.samples), strict=True)
        return cell_number(self.shape, grid_index(self.bounds, self.shape, [self.middle(one) for one in columns]))

    def all(self):
        return [policy for cell in sorted(self.cells) for policy in self.cells[cell]]

    def drawn(self, count, uniforms):
        """The policies that are measured again; one number in [0, 1) for each that is kept."""
        waiting, deepest = [], max((len(ranked) for ranked in self.cells.values()), default=1) - 1
        ranks = [rank for cell in sorted(self.cells) for rank in range(len(self.cells[cell]))]
        for index, rank in enumerate(ranks):
            waiting.append((-math.log(1 - uniforms[index]) / WEIGHTS[self.draw](rank, deepest), index))
        chosen = sorted(index for _, index in sorted(waiting)[:count])
        return [self.all()[index] for index in chosen]

    def parent(self, cell, uniform):
        """The fittest policy of a cell; in a deep grid, one by its share of the fitness above the lowest."""
        ranked = self.cells[cell]
        if self.replaces == "worst":
            return ranked[0]
        above = [self.fitness(one) - self.fitness(ranked[-1]) for one in ranked]
        above = above if above[0] else [1.0] * len(ranked)
        left = uniform * sum(above)
        for one, share in zip(ranked, above, strict=True):
            left -= share
            if left < 0:
                return one
        return ranked[-1]

    def told(self, again, newcomers, uniforms=()):
        """Put in new samples and new policies.

        again: (policy, fitness, descriptor, whether it is valid) of those measured again. newcomers: policies with
        their samples. uniforms: a number for each resident, in the order of `all`, once those that come are out.
        """
        coming = []
        for policy, fitness, descriptor, is_valid in again:
            policy.samples.append((fitness, descriptor))
            if not is_valid or self.place(policy) != policy.cell:
                self.cells[policy.cell].remove(policy)
                coming += [policy] if is_valid else []
        for policy in newcomers:
            policy.serial, self.serial = self.serial, self.serial + 1
            coming.append(policy)
        self.cells = {cell: ranked for cell, ranked in self.cells.items() if ranked}
        turn = dict(zip([one.serial for one in self.all()], uniforms, strict=False))
        for policy in coming:
            policy.cell = self.place(policy)
            self.cells.setdefault(policy.cell, []).append(policy)
        for cell, found in self.cells.items():
            if self.replaces == "any":
                found = sorted(found, key=lambda one: (turn.get(one.serial, -1), one.serial))[: self.depth]
            self.cells[cell] = sorted(found, key=lambda one: (-self.fitness(one), one.serial))[: self.depth]
        self.filled = [cell for cell in self.filled if cell in self.cells]
        new = [cell for cell in self.cells if cell not in self.filled]
        self.filled += sorted(new, key=lambda cell: self.cells[cell][0].serial)
        # A number may be used again once all later ones are gone.
        self.serial = max((one.serial for one in self.all()), default=-1) + 1
