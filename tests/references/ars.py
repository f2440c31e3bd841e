"""ARS once more, in float64 and for reading: what a generation does to the centre, given all fitness values."""

import math

import numpy as np


class ARS:
    def __init__(self, centre, learning_rate, l2, top_pairs):
        self.centre = np.array(centre, np.float64)
        self.learning_rate, self.l2, self.top_pairs = learning_rate, l2, top_pairs

    def generation(self, noise_P_D, fitness_P_S):
        """noise: standard normal, one row per pair; fitness: of centre + sigma noise and centre - sigma noise."""
        valid = [float(f) for f in np.ravel(fitness_P_S) if np.isfinite(f)]
        pairs = [[float(f) if np.isfinite(f) else min(valid) for f in pair] for pair in fitness_P_S]
        best = sorted(range(len(pairs)), key=lambda i: max(pairs[i]), reverse=True)[: self.top_pairs]
        used = [f for i in best for f in pairs[i]]
        mean = sum(used) / len(used)
        spread = math.sqrt(sum((f - mean) ** 2 for f in used) / len(used))
        estimate = np.zeros_like(self.centre)
        for i in best:
            plus, minus = pairs[i]
            estimate += (plus - minus) / (len(best) * spread) * np.asarray(noise_P_D[i], np.float64)
        self.centre = self.centre + self.learning_rate * (estimate - self.l2 * self.centre)
