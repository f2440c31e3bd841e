"""Evaluation of a run's stored policies on fresh episodes, for comparison with their stored fitness.

An elite or a best centre has the highest of many noisy means, so part of its stored fitness is luck. Fresh episodes,
which selection has never seen, show how large that part is. They depend only on the seed, so every policy gets the
same ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from es_service.config.model import RunConfig
from es_service.config.tasks import task_of
from es_service.errors import NotInRunError, WayOut
from es_service.loop.blocks import BEST, CENTRES, OBSERVATIONS
from es_service.loop.generation import evaluate_centres
from es_service.loop.state import merge_moments, moments_of
from es_service.protocol.content import Policy
from es_service.protocol.episodes import Evaluator, completed
from es_service.protocol.messages import EVALUATION_EPISODES_PER_CHUNK, Centre, FloatArray, Moments
from es_service.runs.checked_config import changed_config
from es_service.runs.engine import engine_here
from es_service.runs.snapshot import Snapshot, acting
from es_service.runs.view import Run, named_best
from es_service.runs.worker_count import on_this_machine, require_cores
from es_service.search.maps.behaviour_map import places_of
from es_service.search.maps.geometry import tessellation

CHUNKS_PER_WORKER = 16
"""Chunks per worker that are evaluated side by side: enough to keep all busy, few enough to show results soon."""
EPISODES_AT_ONCE = 2**16
"""Most episodes of a policy whose results are in memory at a time; a constant, since it affects the last bits of the
statistics of more episodes."""
_Totals = tuple[Moments, Moments, int]
"""Moments of the fitness, moments of the descriptors, and number of successes, of the episodes of a policy."""
FRESH_GENERATION = 2**40
"""Generation number in the random streams of fresh episodes with seed 0; no run reaches it."""


@dataclass(frozen=True)
class Candidate:
    """A stored policy to evaluate, with the values stored for it."""

    name: str
    """Its name: "best", "centre", or the place of its cell, such as "3,17"."""
    policy: Policy
    generation: int
    """Generation in which the run evaluated it."""
    stored_fitness: float
    """Mean fitness that the run stored for it."""
    cell: int | None = None
    """Number of its cell, or of that of the grid of a dominated map; None if it is not an elite. The next two are of an
    elite too."""
    centre: int | None = None
    """Number of the evaluated centre or policy."""
    trace_T_B: FloatArray | None = None
    """Descriptor of its first evaluation episode up to each of T points in time."""


@dataclass(frozen=True)
class Fresh:
    """Statistics of a candidate's fresh episodes, whose memory does not depend on the number of episodes."""

    candidate: Candidate
    fitness: Moments
    """Count, mean and squared deviations of the fitness, without axes."""
    descriptors: Moments
    """The same of the descriptors, [B]."""
    successes: int | None
    """Number of fresh episodes that succeeded; None if the task does not declare success."""
    cell: int | None
    """Cell of its mean fresh descriptor; None without a map, or if the descriptor is not finite."""

    @property
    def episodes(self) -> int:
        return int(self.fitness.count)

    @property
    def mean(self) -> float:
        return float(self.fitness.mean_O)

    @property
    def standard_error(self) -> float:
        """Standard error of `mean`: standard deviation (n - 1) divided by the square root of n; NaN for one episode."""
        count = self.episodes
        return sqrt(self.fitness.m2_O / (count - 1)) / sqrt(count) if count > 1 else float("nan")

    @property
    def descriptor(self) -> NDArray[np.float64]:
        """Mean descriptor over the fresh episodes, [B]."""
        return self.descriptors.mean_O

    @property
    def descriptor_std(self) -> NDArray[np.float64]:
        """Standard deviation of the descriptor over the fresh episodes, [B]."""
        return np.sqrt(self.descriptors.m2_O / self.episodes)


def candidates(
    run: Run,
    *,
    best: bool,
    centre: bool,
    cells: Sequence[Sequence[int]],
    every: bool,
    top: int = 0,
    generation: int | None = None,
) -> list[Candidate]:
    """The policies to evaluate: the best centre, the newest centre, then elites.

    The elites are those of `cells` in the given order, then the `top` ones with the highest stored fitness (the older
    entry of equal ones first), or with `every` all of the map in the order of discovery; each elite once. The best
    centre, the newest centre and the elites are each read from one generation, also while a driver is writing.

    Args:
        generation: one whose state the run keeps; None: the newest.

    Raises NotInRunError for a cell that does not exist or is empty, for `every` with an empty map, for `centre` if the
    run has no newest centre, and for a run without a finished generation; StoreError if the generation is not kept.
    """
    if run.generation is None:
        way_out = WayOut("resume", "continue it", str(run.folder))
        raise NotInRunError(f"{run.folder} has no finished generation yet", run=run.folder, ways_out=[way_out])
    chosen = []
    if best:
        snapshot = run.at(generation, [BEST], named_best)
        chosen.append(Candidate("best", snapshot.policy("best"), snapshot.best.generation, snapshot.best.fitness))
    if centre:
        snapshot = run.at(generation, [CENTRES, OBSERVATIONS])
        _, fitness = snapshot.require_newest_centre()
        chosen.append(Candidate("centre", snapshot.policy("centre"), snapshot.generation, fitness))
    if not cells and not every and not top:
        return chosen

    def wanted(snapshot: Snapshot) -> list[int]:
        map_ = snapshot.behaviour_map
        fittest = np.argsort(-map_.fitness_N, kind="stable")[:top]
        return list(dict.fromkeys([*map(snapshot.cell, cells), *map_.cell_N[fittest].tolist()]))

    map_, elites = run.elites(None if every else wanted, generation)
    if not elites and (cells or every):
        raise NotInRunError(f"the map of {run.folder} is empty", run=run.folder)
    place_N = places_of(map_).tolist()
    for cell, elite in elites.items():
        row = map_.row_of(cell)
        assert row is not None
        name = ",".join(map(str, map_.geometry.index_of(cell)))
        evaluated = int(map_.generation_N[row]), float(map_.fitness_N[row])
        chosen.append(
            Candidate(name, acting(run.meta, elite), *evaluated, place_N[row], int(map_.centre_N[row]), elite.trace_T_B)
        )
    return chosen


def evaluation_config(run: Run, workers: int | None = None) -> RunConfig:
    """The config of a run as its policies are evaluated: on this machine, with this number of workers.

    Raises ConfigError if these are too many for its cores, or if the run's own config cannot be read.
    """
    stored = run.present_config
    config = changed_config(stored, on_this_machine(stored, workers), name=str(run.config_file))
    require_cores(config)
    return config


def evaluate(
    run: Run,
    chosen: Sequence[Candidate],
    episodes: int,
    workers: int | None = None,
    seed: int = 0,
    on_notice: Callable[[str], None] = lambda sentence: None,
    on_output: Callable[[str], None] = lambda line: None,
) -> Iterator[Fresh]:
    """Evaluate each candidate on fresh, noise-free episodes on this machine; yield the results in order.

    Args:
        episodes: number of episodes per candidate.
        workers: number of worker processes; None: one per core.
        seed: seed of the evaluation episodes, from 0 to 2**63 - 1.
        on_notice, on_output: as for `engine_here`.

    Raises EvaluationError if the rollouts cannot continue, and Interrupted after SIGINT or SIGTERM; ConfigError as
    `evaluation_config`.
    """
    config = evaluation_config(run, workers)
    cells = tessellation(run.behaviour_map.geometry) if config.map.enabled else None
    chunks = -(-episodes // EVALUATION_EPISODES_PER_CHUNK)
    task = task_of(config)
    outputs = ("success",) if task.success else ()
    with engine_here(config, on_notice, on_output, at_once=chunks * len(chosen), outputs=outputs) as engine:
        together = max(1, CHUNKS_PER_WORKER * engine.counts.workers // chunks)
        for first in range(0, len(chosen), together):
            group = chosen[first : first + together]
            centres = [centre_of(candidate.policy, FRESH_GENERATION + seed) for candidate in group]
            for candidate, (fitness, descriptors, successes) in zip(
                group, _totals(engine, centres, episodes), strict=True
            ):
                cell = None
                if cells is not None and np.isfinite(descriptors.mean_O).all():
                    cell = int(cells.cells_of(descriptors.mean_O[None])[0])
                yield Fresh(candidate, fitness, descriptors, successes if task.success else None, cell)


@np.errstate(invalid="ignore", over="ignore")  # a policy may have an infinite fitness
def _totals(engine: Evaluator, centres: Sequence[Centre], episodes: int) -> list[_Totals]:
    """Moments of the fitness and of the descriptors of each centre, and its number of successes, a limited number of
    episodes at a time."""
    totals: list[_Totals] = []
    for start in range(0, episodes, EPISODES_AT_ONCE):
        count, first = min(EPISODES_AT_ONCE, episodes - start), start // EVALUATION_EPISODES_PER_CHUNK
        results = completed(evaluate_centres(centres, count, resets="same", first=first), engine.evaluate)
        parts = [
            (moments_of(of.fitness[0]), moments_of(of.descriptor[0]), int(np.sum(of.outputs.get("success", 0))))
            for of in results
        ]
        totals = list(map(_added, totals, parts)) if totals else parts
    return totals


def _added(total: _Totals, part: _Totals) -> _Totals:
    return merge_moments(total[0], [part[0]]), merge_moments(total[1], [part[1]]), total[2] + part[2]


def centre_of(policy: Policy, generation: int) -> Centre:
    """A policy as a centre of a generation, to be evaluated without noise."""
    return Centre(generation, policy.parameters_D, 0.0, policy.observation_mean_O, policy.observation_std_O)
