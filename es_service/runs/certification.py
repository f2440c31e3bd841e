"""Certified values: what a chosen policy returns in episodes that neither training nor any choice has seen.

The stored value of an elite or of a best centre is the highest of many noisy means, so it is partly luck. Candidates
are therefore reduced by successive halving with *selection* episodes, and only the policies that remain get
*certification* episodes. Both have a domain of random streams of their own, which no seed of `evaluate` reaches, and
each certification of a run has new episodes. The certified policy is the one that the selection episodes put first,
never the one with the best certified value. Whether a run has reached `budget.target_certified` is decided by episodes
of a third domain (`sessions.py`).

Axes: N candidates, E episodes, D policy parameters, O observation.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from numpy.typing import ArrayLike

from es_service.config.given import Overrides, Source
from es_service.config.model import RunConfig
from es_service.config.parts import TargetObjective
from es_service.config.search import CandidatesConfig
from es_service.config.tasks import task_of
from es_service.config.workload import policy_spec
from es_service.errors import ConfigError, NotInRunError, StoreError
from es_service.protocol.content import Policy
from es_service.protocol.episodes import Evaluator
from es_service.protocol.machine import CODE, platform_info
from es_service.protocol.messages import EpisodesResult, TaskSpec
from es_service.runs.certified import (
    EPISODES,
    Certified,
    Elsewhere,
    measure_of,
    resets_of,
    stored,
)
from es_service.runs.checked_config import code_of
from es_service.runs.engine import engine_here
from es_service.runs.evaluation import Candidate, candidates, evaluation_config
from es_service.runs.evaluator import evaluating_config, policies_of, statistics_of, whole
from es_service.runs.other_task import FIRST_OBSERVATION, OtherTask, elsewhere_of, other_task
from es_service.runs.selection import RANKED_BY, RankedBy, halved, kept, results_of
from es_service.runs.session import show_notice
from es_service.runs.view import Run, open_run
from es_service.runs.waiting import telling_once, when_free
from es_service.store.reader import read_history
from es_service.store.writer import RunStore

OTHER_PROGRAMS = 2**40
"""Added to the numbers of certifications of other programs' policies, so that no run has their episodes."""
TOP = 10
"""Default number of elites that are candidates beside the best centre."""


@dataclass(frozen=True)
class NamedPolicy:
    name: str
    policy: Policy
    generation: int | None = None
    stored_fitness: float | None = None


def certify_run(
    folder: str | os.PathLike[str],
    *,
    best: bool = True,
    centre: bool = False,
    cells: Sequence[Sequence[int]] = (),
    top: int | None = None,
    generation: int | None = None,
    episodes: int = EPISODES,
    keep: int = 1,
    by: RankedBy | None = None,
    task: str | None = None,
    overrides: Overrides = (),
    workers: int | None = None,
    on_notice: Callable[[str], None] = show_notice,
    on_output: Callable[[str], None] = lambda line: None,
) -> list[Certified]:
    """Certify policies of a run on this machine, and store the results in the run.

    With `task`, the policies that remain get as many episodes in this other task, too, such as the same one in another
    simulator. Selection asks only the run's own task.

    Args:
        best, centre, cells, top: the candidates: the best centre, the newest centre, elites of cells, and the elites
            with the highest stored fitness; None: 10 of them, or none in a run without a map.
        generation: one whose state the run keeps, from which the candidates are taken; None: the newest.
        episodes: number of certification episodes of each policy that remains.
        keep: number of policies that remain after selection.
        by: what selection ranks by; None: what `default_measure` says. Equal ones rank by their return, and then
            in the order of the candidates.
        task: name of the other task; None: none.
        overrides: its options, such as "task.options.frame_skip=5"; see `other_task`.
        workers: number of worker processes; None: one per core.
        on_notice: called with a sentence about each repair of the run, when the workers compile for more than two
            seconds, and when the first is replaced by a new process; by default, it is printed as a line on stderr.
        on_output: called with the lines that workers print; see `run`.

    Returns:
        The policies that remain, in the order of selection.

    Raises:
        RunLockedError: a driver is writing to the run; the message names it. NotInRunError: a candidate does not exist.
        ConfigError: a number is wrong, the task does not have what `by` names, or the other task does not fit the
        policies. EvaluationError: the rollouts cannot
        continue. Interrupted: SIGINT or SIGTERM arrived. Then nothing is stored.
    """
    for name, value, least in (("episodes", episodes, 2), ("keep", keep, 1), ("top", top or 0, 0)):
        whole(name, value, least)
    generation = None if generation is None else int(generation)  # of NumPy, from a table
    run = open_run(folder)
    with opened(run, workers, on_notice) as (store, config):
        _measure(config, by)  # refused before workers start if wrong
        other = None if task is None else other_task(config, task, overrides)
        for difference in () if other is None else other.differences:
            on_notice(difference)
        if top is None:
            top = TOP if config.map.enabled else 0
        chosen = candidates(run, best=best, centre=centre, cells=cells, every=False, top=top, generation=generation)
        if not chosen:
            why = "its map is empty" if top else "no candidate is named"
            raise NotInRunError(f"{run.folder}: there is no policy to certify; {why}", run=run.folder)
        given, number = different(chosen), store.next_certification
        certified = _certify(config, given, number, episodes, keep, by, on_output, on_notice, other)
        return add_certified(store, certified, on_notice, generation)


def add_certified(
    store: RunStore,
    certified: Sequence[Certified],
    on_notice: Callable[[str], None],
    generation: int | None = None,
) -> list[Certified]:
    """Store a certification in its run, once no other program holds the database; returns it as it is stored.

    Args:
        generation: that from whose state the candidates were taken; None: the newest.
    """
    row = store.last_history() if generation is None else next(iter(read_history(store.folder, generation, 1)), None)
    env_steps = None if row is None else int(row["env_steps"])
    certified = [replace(policy, env_steps=env_steps) for policy in certified]
    rows, contents = [stored(one) for one in certified], {one.policy.name: one.policy.content for one in certified}
    when_free(partial(store.add_certification, rows, contents), telling_once(store.folder, on_notice))
    return certified


@contextmanager
def opened(run: Run, workers: int | None, on_notice: Callable[[str], None]) -> Iterator[tuple[RunStore, RunConfig]]:
    """The store of a run that no driver holds, and the config with which its policies are certified on this machine.

    After an error, the store advises to resume the run; here it is the certification that is repeated.
    """
    try:
        with when_free(partial(RunStore.open, run.folder), telling_once(run.folder, on_notice)) as store:
            for notice in store.notices:
                on_notice(notice)
            yield store, evaluation_config(run, workers)
    except StoreError as error:
        error.ways_out = tuple(
            replace(way, action="certify", purpose="certify it after the cause is removed")
            if way.action == "resume"
            else way
            for way in error.ways_out
        )
        raise


def certify(
    parameters: ArrayLike,
    config: RunConfig | Source,
    *,
    episodes: int = EPISODES,
    keep: int = 1,
    by: RankedBy | None = None,
    number: int = 0,
    observation_mean: ArrayLike | None = None,
    observation_std: ArrayLike | None = None,
    workers: int | None = None,
    on_output: Callable[[str], None] = lambda line: None,
) -> list[Certified]:
    """Certify policies of another program on this machine, by the rules of `certify_run`; nothing is stored.

    Args:
        parameters: candidates [N, D].
        config: a RunConfig, or what `load_config` accepts; its task, policy and seed are used.
        number: number of the certification. Another one with the same number has the same episodes, so give the next
            number if the policies have been changed after a look at the results.
        observation_mean, observation_std: statistics with which observations are normalised, [O] or [N, O]; None: 0 and
            1.
        on_output: called with the lines that workers print; see `run`.

    Returns:
        The policies that remain, in the order of selection; `name` is the index of a policy in `parameters`.

    Raises:
        ConfigError: an argument is wrong. Otherwise as `certify_run`.
    """
    for name, value, least in (("episodes", episodes, 2), ("keep", keep, 1), ("number", number, 0)):
        whole(name, value, least)
    config = evaluating_config(config, workers, "inline", None)
    _measure(config, by)
    task = task_of(config)
    policies_N_D = policies_of(config, task, parameters)
    statistics = statistics_of(task, len(policies_N_D), observation_mean, observation_std)
    spec, each = policy_spec(config, task), zip(policies_N_D, *statistics, strict=True)
    given = [NamedPolicy(str(index), Policy(spec, *arrays)) for index, arrays in enumerate(each)]
    return _certify(config, given, OTHER_PROGRAMS + number, episodes, keep, by, on_output)


def _certify(
    config: RunConfig,
    given: Sequence[NamedPolicy],
    number: int,
    episodes: int,
    keep: int,
    by: RankedBy | None,
    on_output: Callable[[str], None],
    on_notice: Callable[[str], None] = lambda sentence: None,
    other: OtherTask | None = None,
) -> list[Certified]:
    """Select among candidates, then certify those that remain, in another task, too, if there is one."""
    measure, platform = _measure(config, by), platform_of(config, other)
    seed, domain = resets_of(config.seed, None if other is None else other.task.name)

    def reported(engine: Evaluator) -> list[EpisodesResult]:
        return results_of(engine, policies, episodes, seed, number, 0, domain)

    with workers_for(config, on_notice, on_output) as engine:
        ranked, steps = halved(engine, [named.policy for named in given], config.seed, number, keep, measure)
        policies = [given[record.index].policy for record in ranked]
        results = reported(engine) if other is None else []
    elsewhere: list[Elsewhere | None] = [None] * len(ranked)
    if other is not None:
        with workers_for(config, on_notice, on_output, compared=True) as engine:
            results = reported(engine)
        with workers_for(other.config, on_notice, on_output, compared=True) as engine:
            elsewhere = [elsewhere_of(other, *pair) for pair in zip(results, reported(engine), strict=True)]
    certified = []
    for rank, (record, result) in enumerate(zip(ranked, results, strict=True)):
        candidate = given[record.index]
        certified.append(
            Certified(
                number,
                rank,
                candidate.name,
                candidate.generation,
                candidate.stored_fitness,
                measure,
                record.mean(measure) if record.count else None,
                record.count,
                len(given),
                steps,
                False,
                0,
                platform,
                kept(result),
                candidate.policy,
                elsewhere[rank],
            )
        )
    return certified


def platform_of(config: RunConfig, other: OtherTask | None = None) -> dict[str, Any]:
    """What computes episodes in this process, as it is stored: those of a run, and of another task if there is one."""
    code = [code_of(one) for one in (config, *([] if other is None else [other.config]))]
    return {**platform_info(), CODE: {file: sha256 for of in code for file, sha256 in of.items()}}


def different(chosen: Sequence[Candidate]) -> list[NamedPolicy]:
    """The candidates; of equal policies only the first, since the best centre is often an elite as well."""
    found: dict[bytes, NamedPolicy] = {}
    for candidate in chosen:
        named = NamedPolicy(candidate.name, candidate.policy, candidate.generation, candidate.stored_fitness)
        found.setdefault(candidate.policy.name, named)
    return list(found.values())


def workers_for(
    config: RunConfig,
    on_notice: Callable[[str], None] = lambda sentence: None,
    on_output: Callable[[str], None] = lambda line: None,
    *,
    compared: bool = False,
) -> AbstractContextManager[Evaluator]:
    """Workers on this machine that give what certification keeps.

    Args:
        on_notice, on_output: as for `engine_here`.
        compared: whether the episodes are compared with those of another task: then they begin as there as far as they
            can, and have their first observations.
    """
    task = task_of(config)
    outputs = certified_outputs(task)
    if compared and task.parameters is None:
        outputs = (*outputs, FIRST_OBSERVATION)
    return engine_here(config, on_notice, on_output, outputs=outputs, keyed_resets=compared)


def certified_outputs(task: TaskSpec) -> tuple[str, ...]:
    """Outputs that the episodes of a certification name."""
    return ("last_reward", "success") if task.success else ("last_reward",)


def _measure(config: RunConfig, by: RankedBy | None) -> RankedBy:
    """What selection ranks by. Raises ConfigError if the task does not have it."""
    task = task_of(config)
    lacking = {"success": not task.success, "goal_distance": not task.has_goal}
    if by is not None and (by not in RANKED_BY or lacking.get(by)):
        allowed = [name for name in RANKED_BY if not lacking.get(name)]
        raise ConfigError(
            f"by = {by}: {config.task.environment} has no such measure; choose {', '.join(allowed)}",
            field="by",
            value=by,
            allowed=", ".join(allowed),
        )
    return by or default_measure(config)


def default_measure(config: RunConfig) -> RankedBy:
    """What policies of a run are selected by: success if it polishes for a target set in a task that declares success,
    else what its `task.fitness` says."""
    has_target = isinstance(config.search, CandidatesConfig) and isinstance(config.search.objective, TargetObjective)
    return "success" if has_target and task_of(config).success else measure_of(config.task.fitness)
