"""NS-ES, NSR-ES and NSRA-ES once more, slowly and in float64: written for reading, one number at a time."""

from __future__ import annotations

import math

from tests.references.es import ES, SHAPINGS


def novelty(archive, descriptor, neighbours, squared=False, without=None):
    """Mean distance to the nearest entries of a list of descriptors, adding the smallest first."""
    distances = []
    for index, entry in enumerate(archive):
        if index != without:
            square = 0.0
            for x, y in zip(descriptor, entry, strict=True):
                square += (float(x) - float(y)) * (float(x) - float(y))
            distances.append(square)
    nearest = sorted(distances)[:neighbours]
    total = 0.0
    for square in nearest:
        total += square if squared else math.sqrt(square)
    return total / len(nearest) if nearest else 0.0


class NoveltySearch:
    def __init__(self, centres, learning_rate, l2, *, neighbours, weight, rule=None, squared=False, shaping="ranks"):
        """rule: None, or (step, patience, minimum relative gain) of the adaptive weight."""
        self.centres = [ES(centre, learning_rate, l2) for centre in centres]
        self.archive, self.newest_entry = [], [None] * len(centres)
        self.neighbours, self.squared, self.weight, self.rule = neighbours, squared, weight, rule
        self.record, self.stagnant, self.shaped = None, 0, SHAPINGS[shaping]

    def chosen(self, uniform):
        """Roulette over the centres' novelties, for a number drawn from [0, 1)."""
        newest = [(i, self.archive[i]) for i in self.newest_entry]
        shares = [novelty(self.archive, x, self.neighbours, self.squared, without=i) for i, x in newest]
        if sum(shares) == 0.0:
            shares = [1.0] * len(shares)
        below = 0.0
        for index, share in enumerate(shares):
            below += share
            if uniform * sum(shares) < below:
                return index
        raise AssertionError

    def generation(self, centre, noise_P_D, fitness_P_S, descriptor_P_S_B):
        pairs = len(noise_P_D)
        reward = self.shaped(fitness_P_S.ravel())
        novel = self.shaped(
            [novelty(self.archive, x, self.neighbours, self.squared) for x in descriptor_P_S_B.reshape(2 * pairs, -1)]
        )
        mixed = self.weight * reward + (1 - self.weight) * novel
        self.centres[centre].climb(noise_P_D, mixed.reshape(pairs, 2))

    def initial(self, centre, descriptor):
        self.newest_entry[centre] = len(self.archive)
        self.archive.append(descriptor)

    def evaluated(self, centre, fitness, descriptor):
        self.told([(centre, fitness, descriptor)])

    def told(self, evaluations):
        """Learn from all evaluations of one generation: (centre, fitness, descriptor) in their order."""
        for centre, _, descriptor in evaluations:
            self.initial(centre, descriptor)
        if self.rule is None:
            return
        step, patience, gain = self.rule
        beaten = False
        for _, fitness, _ in evaluations:
            if self.record is None or fitness > self.record + gain * abs(self.record):
                self.record, self.weight, beaten = fitness, min(1.0, self.weight + step), True
        self.stagnant = 0 if beaten else self.stagnant + 1
        if self.stagnant == patience:
            self.stagnant, self.weight = 0, max(0.0, self.weight - step)
