"""What the novelty archive costs the driver: milliseconds a generation, on one core.

    python -m tests.benchmarks.novelty_time

A generation adds one entry, judges 1,024 descriptors and five centres. The mean over TREE_STEP generations includes one
new tree; the brute-force row judges the same queries against every entry. Ends are anywhere, or a fifth of them, of the
archive's and the queries', among the 600 places of a border.
"""

from __future__ import annotations

import os
import time

import numpy as np

from es_service.search.novelty import TREE_STEP, NoveltyArchive, extended, novelty

QUERIES = 1024
CENTRES = 5


def ends(rng: np.random.Generator, count: int, at_border: float) -> np.ndarray:
    """Places in the square, a share of them at its border, where many are the same."""
    place_N_2 = rng.uniform(-1, 1, (count, 2))
    there = np.flatnonzero(rng.random(count) < at_border)
    place_N_2[there] = np.round(place_N_2[there] * 75) / 75
    place_N_2[there, rng.integers(0, 2, len(there))] = rng.choice([-1.0, 1.0], len(there))
    return place_N_2


def main() -> None:
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    rng = np.random.default_rng(0)
    print(f"{'entries':>8} {'at border':>9} {'tree ms':>8} {'slowest ms':>10} {'brute ms':>9}")
    for entries, at_border in ((1_000, 0.0), (10_000, 0.0), (100_000, 0.0), (100_000, 0.2)):
        descriptors = ends(rng, entries, at_border)
        archive = NoveltyArchive(descriptors[:-1], np.arange(entries - 1), np.zeros(entries - 1, np.int64))
        archive = extended(archive, descriptors[-1], entries, 0)  # plants the tree
        queries = ends(rng, QUERIES, at_border)
        newest = np.arange(entries - CENTRES, entries)
        seconds = []
        for generation in range(TREE_STEP):
            start = time.perf_counter()
            archive = extended(archive, rng.uniform(-1, 1, 2), entries + generation, 0)
            centres = archive.descriptor_N_B[newest]
            novelty(archive, centres, neighbours=10, distance="euclidean", exclude_Q=newest)
            with_tree = novelty(archive, queries, neighbours=10, distance="euclidean")
            seconds.append(time.perf_counter() - start)
        without = NoveltyArchive(archive.descriptor_N_B, archive.generation_N, archive.centre_N)
        start = time.perf_counter()
        brute = np.concatenate(
            [novelty(without, some, neighbours=10, distance="euclidean") for some in np.array_split(queries, 16)]
        )
        brute_s = time.perf_counter() - start
        assert np.array_equal(brute, with_tree)
        tree_ms, slowest_ms = 1e3 * np.mean(seconds), 1e3 * max(seconds)
        print(f"{entries:8,} {at_border:9.0%} {tree_ms:8.2f} {slowest_ms:10.2f} {1e3 * brute_s:9.1f}", flush=True)


if __name__ == "__main__":
    main()
