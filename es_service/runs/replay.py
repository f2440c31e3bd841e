"""Recording of episodes of a run's stored policies, for replays: the very episodes that the run evaluated.

Of the best centre and of elites, the first evaluation episode is recorded, the one whose path the map stores. The run
stores the address of its reset, its fitness and, for an elite, its path; the recording is compared with them, so that a
replay never passes for something that it is not. Of the certified policy, the certification episode of median fitness
is recorded, which shows neither its luck nor its bad luck.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from es_service.config.model import ENGINE_IMPLIES, RunConfig
from es_service.config.tasks import task_of
from es_service.config.workload import worker_spec
from es_service.errors import EvaluationError
from es_service.loop.history import Resets
from es_service.protocol.child import NoAnswerError, answer_of
from es_service.protocol.machine import CODE, platform_info
from es_service.protocol.messages import FloatArray
from es_service.protocol.recordings import Recording, Recordings, RecordRequest
from es_service.protocol.user_code import RaisedError
from es_service.runs.certified import newest_certified
from es_service.runs.checked_config import changed_config, changes_since, code_of
from es_service.runs.evaluation import Candidate, candidates, centre_of
from es_service.runs.view import Run
from es_service.runs.worker_count import GPU
from es_service.store import reader

CERTIFIED = "certified"
"""Name of the certified policy as a candidate, whose generation is the number of the certification."""
RECORD_S = 600.0
"""Longest time for the recordings of one report, compilation included."""


@dataclass(frozen=True)
class Replay:
    """A recorded episode of a stored policy."""

    candidate: Candidate
    recording: Recording
    stored: StoredEpisode | None
    """What the run has stored of the episode; None if it has nothing: the recording is then of another episode of the
    policy, and `candidate.stored_fitness` is not finite if a fork has discarded the evaluation."""

    @property
    def is_the_stored(self) -> bool:
        """Whether fitness and path are those stored, bit for bit."""
        if self.stored is None:
            return False
        trace_T_B = self.stored.trace_T_B
        same_path = trace_T_B is None or np.array_equal(trace_T_B, self.recording.trace_T_B)
        return self.recording.fitness == self.stored.fitness and same_path


@dataclass(frozen=True)
class StoredEpisode:
    """What a run has stored of an episode of a policy."""

    request: RecordRequest
    fitness: float
    trace_T_B: FloatArray | None
    """Its path; None for a policy that is no elite."""
    changes: tuple[str, ...]
    """Differences between what computed it and this machine, in words: packages, processor, code."""
    certification: int | None = None
    """Number of the certification whose episode it is; None for an evaluation episode."""


def record(
    run: Run, *, best: bool, cells: Sequence[Sequence[int]], certified: bool = False
) -> tuple[list[Replay], Recordings]:
    """Record an episode of each policy in a child process on this machine, see above.

    Args:
        best: whether the best centre is recorded.
        cells: places of the cells whose elites are.
        certified: whether the certified policy is, which comes first.

    Raises:
        NotInRunError: a cell does not exist or is empty, or the run has no finished generation, or no certified policy.
            ConfigError: the task cannot be used on this machine. EvaluationError: the recording failed.
    """
    overrides = {"compute.engine": "inline", **ENGINE_IMPLIES["inline"], GPU: 0, "compute.workers": "auto"}
    config = changed_config(run.present_config, overrides, name=str(run.config_file))
    chosen = candidates(run, best=best, centre=False, cells=cells, every=False)
    now = {**platform_info(), CODE: code_of(config)}
    stored = [_stored(run, candidate, now) for candidate in chosen]
    if certified:
        policy, episode = _certified(run, config, now)
        chosen, stored = [policy, *chosen], [episode, *stored]
    requests = [
        RecordRequest(centre_of(candidate.policy, candidate.generation), config.seed) if its is None else its.request
        for candidate, its in zip(chosen, stored, strict=True)
    ]
    task, spec = config.task.environment, worker_spec(config, task_of(config))
    try:
        recorded = answer_of("workers.rollouts:recorder", task, spec, request=(requests,), limit_s=RECORD_S)
    except (NoAnswerError, RaisedError) as error:
        why = f"their process {error}" if isinstance(error, NoAnswerError) else error
        raise EvaluationError(f"episodes could not be recorded: {why}") from None
    return [Replay(*parts) for parts in zip(chosen, recorded.recordings, stored, strict=True)], recorded


def _certified(run: Run, config: RunConfig, now: Mapping[str, Any]) -> tuple[Candidate, StoredEpisode]:
    """The newest certified policy, and its certification episode of median fitness, the lower one of two.

    Raises NotInRunError if there is none.
    """
    policy, certified = run.policy("certified"), newest_certified(run.folder)
    assert certified is not None
    fitness_E = certified.episodes.fitness(config.task.fitness)
    episode = int(np.argsort(fitness_E, kind="stable")[(fitness_E.size - 1) // 2])
    candidate = Candidate(CERTIFIED, policy, certified.number, float(fitness_E.mean()))
    centre = centre_of(policy, certified.number)
    seed, domain = certified.resets(config.seed)
    request = RecordRequest(centre, seed, policy=0, episode=episode, domain=domain)
    changes = tuple(changes_since(certified.platform, now))
    return candidate, StoredEpisode(request, float(fitness_E[episode]), None, changes, certified.number)


def _stored(run: Run, candidate: Candidate, now: Mapping[str, Any]) -> StoredEpisode | None:
    """What is stored of a policy's first evaluation episode; None if its address is not."""
    if not np.isfinite(candidate.stored_fitness):
        return None  # a fork that changed the meaning of fitness has kept the policy, but not its evaluation
    centre = candidate.centre
    if centre is None:
        [history] = reader.read_history(run.folder, candidate.generation, 1)
        centre = history["centre"]  # the best was the fittest of its generation
    [rows] = reader.read_evaluations(run.folder, candidate.generation, 1)
    row = next((row for row in rows if row["centre"] == centre), {})
    seed, episode, ask, policy = (row.get(f"reset_{field.name}", np.nan) for field in fields(Resets))
    if np.isnan(seed):
        return None
    resets = Resets(int(seed), int(episode), int(ask), None if np.isnan(policy) else int(policy))
    then = next((at for first, at in reversed(reader.read_platforms(run.folder)) if first <= candidate.generation), {})
    changes = changes_since(then, now)
    parent, rollout = run.meta.parent, run.constants["compute.rollout"]
    if parent is not None and candidate.generation <= parent["generation"] and reader.read_start(run.folder) is None:
        rollouts = parent.get("rollouts", ["unknown"])  # this run is a fork, and its parent has computed the episode
        changes += [f"rollout {' or '.join(rollouts)} -> {rollout}"] if rollouts != [rollout] else []
    request = RecordRequest(centre_of(candidate.policy, candidate.generation), **vars(resets))
    return StoredEpisode(request, row["fitness_first"], candidate.trace_T_B, tuple(changes))
