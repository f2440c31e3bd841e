"""Plain ES once more, in float64 and for reading: what a few generations do to the centre, given all fitness values."""

import numpy as np


def averaged_centred_ranks(fitness):
    """Rank of each value among all, ties averaged, not-finite values lowest; scaled to [-0.5, 0.5]."""
    values = [f if np.isfinite(f) else -np.inf for f in fitness]
    ranks = []
    for value in values:
        below = sum(other < value for other in values)
        equal = sum(other == value for other in values)
        ranks.append(below + (equal - 1) / 2)
    return np.array(ranks) / (len(values) - 1) - 0.5


def signs_of_pairs(fitness):
    """Of each two values that follow each other, half of +1 for the higher and half of -1 for the lower."""
    values = [f if np.isfinite(f) else -np.inf for f in fitness]
    utilities = []
    for plus, minus in zip(values[::2], values[1::2], strict=True):
        better = 0 if plus == minus else 1 if plus > minus else -1
        utilities += [better / 2, -better / 2]
    return np.array(utilities)


def standardised(fitness):
    """Values less their mean, over their standard deviation; those that are not finite count as the lowest other."""
    valid = [f for f in fitness if np.isfinite(f)]
    values = np.array([f if np.isfinite(f) else min(valid, default=0.0) for f in fitness], np.float64)
    return np.zeros(len(values)) if min(values) == max(values) else (values - values.mean()) / values.std()


SHAPINGS = {"ranks": averaged_centred_ranks, "signs": signs_of_pairs, "returns": standardised}


class ES:
    def __init__(self, centre, learning_rate, l2, shaping="ranks"):
        self.centre = np.array(centre, np.float64)
        self.learning_rate, self.l2, self.shaped = learning_rate, l2, SHAPINGS[shaping]
        self.m, self.v, self.t = np.zeros_like(self.centre), np.zeros_like(self.centre), 0

    def generation(self, noise_P_D, fitness_P_S):
        """noise: standard normal, one row per pair; fitness: of centre + sigma noise and centre - sigma noise."""
        return self.climb(noise_P_D, self.shaped(np.ravel(fitness_P_S)).reshape(len(noise_P_D), 2))

    def climb(self, noise_P_D, utility_P_S):
        """One step of Adam up the gradient estimate."""
        pairs = len(noise_P_D)
        gradient = np.zeros_like(self.centre)
        for i in range(pairs):
            gradient += (utility_P_S[i, 0] - utility_P_S[i, 1]) * np.asarray(noise_P_D[i], np.float64)
        gradient /= pairs
        g = -gradient + self.l2 * self.centre
        self.t += 1
        self.m = 0.9 * self.m + 0.1 * g
        self.v = 0.999 * self.v + 0.001 * g * g
        rate = self.learning_rate * np.sqrt(1 - 0.999**self.t) / (1 - 0.9**self.t)
        self.centre = self.centre - rate * self.m / (np.sqrt(self.v) + 1e-8)
        return gradient
