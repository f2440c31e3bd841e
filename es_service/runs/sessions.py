"""The sessions of a run: created, or opened and continued, until its budget is spent or its target is certified."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any
from uuid import uuid4

from es_service.config.changes import again_with
from es_service.config.model import RunConfig
from es_service.config.tasks import require_same_task, task_of
from es_service.config.workload import require_episodes
from es_service.dispatch import events
from es_service.errors import StartError, WayOut
from es_service.logs import in_run
from es_service.protocol.content import Policy
from es_service.protocol.episodes import OverlappedRequests
from es_service.protocol.noise import Domain
from es_service.protocol.process_environment import require_no_import_of_a_task
from es_service.runs.certification import NamedPolicy, add_certified, different, opened, platform_of, workers_for
from es_service.runs.certified import (
    EPISODES,
    Certified,
    all_certifications,
    decisions,
    measure_of,
    passed,
    report_of,
    target_reached,
)
from es_service.runs.checked_config import accepted, columns, require_resumable
from es_service.runs.evaluation import candidates
from es_service.runs.selection import StoredEpisodes, new_episodes
from es_service.runs.session import TO_CERTIFY, OnGeneration, OnNotice, Outcome, Told, work
from es_service.runs.view import open_run
from es_service.runs.waiting import telling_once, when_free
from es_service.runs.worker_count import require_cores
from es_service.store.create import Beginning, remove_run_folder
from es_service.store.folder import CONFIG, explained, write_config
from es_service.store.schema import RunMeta
from es_service.store.writer import RunStore, no_hook

# When a run is over because its best centre reaches `budget.target_certified`.
#
# The best centre of a run is the best of many noisy evaluations, so that it reaches a target by luck as well. A session
# therefore ends when the best centre seems to reach it, and new episodes decide whether it does. If it does not, the
# run continues until a better one seems to. A run that decides often passes by luck as well, and the episodes with
# which a policy has passed are too good on average. They are therefore not its value: after a pass, further episodes
# are, which decide nothing. The run is over even if they lie below the target.

BEST = "best"
"""Name of the best centre among the candidates of a certification."""


def certify_best(
    folder: Path, config: RunConfig, on_notice: Callable[[str], None], on_output: Callable[[str], None]
) -> None:
    """Decide whether the best centre of a run that no driver holds reaches the target; if so, certify it.

    Each result is stored at once. After an interruption, the next call begins with what is missing.
    """
    workers = None if config.compute.workers == "auto" or config.compute.address else config.compute.workers
    run, target = open_run(folder), config.budget.target_certified
    assert target is not None
    with opened(run, workers, on_notice) as (store, local), workers_for(local, on_notice, on_output) as engine:
        [best] = different(candidates(run, best=True, centre=False, cells=(), every=False))

        def episodes_of(policy: Policy, number: int, domain: Domain) -> StoredEpisodes:
            [episodes] = new_episodes(engine, [policy], EPISODES, config.seed, number, 0, domain)
            return episodes

        policies, number = all_certifications(folder), store.next_certification
        for one in attempt(policies, best, number, target, config.task.fitness, platform_of(local), episodes_of):
            add_certified(store, [one], on_notice)
            mean = one.episodes.mean_fitness(config.task.fitness)
            if one.decides and not mean >= target:
                on_notice(
                    f"the best centre, of generation {one.generation}, does not reach budget.target_certified = "
                    f"{target:g} in {one.episodes.count} new episodes: {mean:.6g}; "
                    "the run continues unless its budget is spent"
                )


def attempt(
    policies: Sequence[Certified],
    best: NamedPolicy,
    number: int,
    target: float,
    fitness: str,
    platform: Mapping[str, Any],
    episodes_of: Callable[[Policy, int, Domain], StoredEpisodes],
) -> Iterator[Certified]:
    """What a run needs next: a decision on its best centre, unless one has passed already, and after a pass, the
    certified value of the policy that has passed.

    Args:
        policies: certifications and decisions of the run so far.
        number: that of the next one.
        fitness: `task.fitness`.
        platform: what computes the episodes.
        episodes_of: (policy, number, domain) -> EPISODES new episodes.
    """
    before, decision = decisions(policies), passed(policies, target, fitness)
    if decision is None:
        decision = Certified(
            number=number,
            rank=0,
            name=BEST,
            generation=best.generation,
            stored_fitness=best.stored_fitness,
            selected_by=measure_of(fitness),
            selection_mean=None,
            selection_episodes=0,
            candidates=1,
            selection_steps=sum(one.episodes.steps for one in before),
            decides=True,
            tries=len(before) + 1,
            platform=platform,
            episodes=episodes_of(best.policy, number, Domain.DECISION_RESET),
            policy=best.policy,
        )
        yield decision
        before, number = [*before, decision], number + 1
        if passed([decision], target, fitness) is None:
            return
    yield replace(
        decision,
        number=number,
        selection_mean=decision.episodes.mean_fitness(fitness),
        selection_episodes=decision.episodes.count,
        selection_steps=sum(one.episodes.steps for one in before),
        decides=False,
        tries=len(before),
        platform=platform,
        episodes=episodes_of(decision.policy, number, Domain.CERTIFICATION_RESET),
    )


def due(folder: Path, config: RunConfig) -> Callable[[Mapping[str, Any] | None], bool]:
    """Function that says of a row of the history whether `certify_best` is to be called; see `due_after`.

    It is so after an interruption, too: a session begins with what the one before did not come to.
    """
    target = config.budget.target_certified
    return (lambda row: False) if target is None else due_after(all_certifications(folder), target, config.task.fitness)


def due_after(policies: Sequence[Certified], target: float, fitness: str) -> Callable[[Mapping[str, Any] | None], bool]:
    """Function that says of a row of the history whether something is to be decided or certified.

    That is when the stored fitness of the best centre reaches the target and exceeds that of every best centre that was
    decided on before; or when a policy has passed and its certified value is missing.

    Args:
        policies: certifications and decisions of the run so far.
    """
    decision = passed(policies, target, fitness)
    if decision is not None:
        is_missing = report_of(policies, decision) is None
        return lambda row: row is not None and is_missing
    tested = [one.stored_fitness for one in decisions(policies) if one.name == BEST]
    most = max((stored_fitness for stored_fitness in tested if stored_fitness is not None), default=-math.inf)
    return lambda row: row is not None and row["best_fitness"] >= target and row["best_fitness"] > most


@dataclass(frozen=True)
class Listener:
    """Functions that a session calls; `api.run` describes them."""

    shown: Callable[[Path], AbstractContextManager[OnGeneration]]
    """Function from a run's folder to a context manager with what is called with each history row."""
    on_notice: OnNotice
    on_compile: OnNotice
    on_output: OnNotice
    hook: Callable[[str], None] = no_hook
    told: Told | None = None
    """Metrics of the caller, if it computes the episodes, so that the sessions yield their work to it."""

    @property
    def asks_caller(self) -> bool:
        """Whether the caller computes the episodes."""
        return self.told is not None


def create_run(
    config: RunConfig,
    folder: Path,
    parent: dict[str, Any] | None,
    beginning: Beginning,
    again: WayOut,
    listener: Listener,
) -> OverlappedRequests[Outcome]:
    """Create a run and work on it; yields as `session.work`. If no worker can be started, there is no run afterwards.

    Args:
        again: the call that was made, which ways out repeat with other settings.
    """
    require_no_import_of_a_task()
    require_cores(config, again)
    require_same_task(config)
    is_new, task = not folder.exists(), task_of(accepted(config))
    require_episodes(task, asks_caller=listener.asks_caller)
    history, evaluations = columns(config, task)
    meta = RunMeta(
        run_id=uuid4().hex,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        config=config.model_dump(mode="json"),
        given=dict(config.made.given),
        constants=config.constants(),
        task=asdict(task),
        columns=history,
        evaluation_columns=evaluations,
        parent=parent,
    )
    with (
        RunStore.create(folder, config.resolved_yaml(), meta, beginning, hook=listener.hook) as store,
        in_run(meta.run_id),
        listener.shown(folder) as on_generation,
    ):
        begun = store.generation
        try:
            listening = on_generation, listener.on_notice, listener.on_compile, listener.on_output
            outcome = yield from work(config, store, *listening, told=listener.told, is_due=due(folder, config))
        except StartError as error:
            if store.generation != begun:
                raise  # of something else that the caller started in a callback: this run has computed generations
            store.close()
            (folder / events.FILE).unlink(missing_ok=True)
            remove_run_folder(folder, whole=is_new)
            error.run = None
            error.ways_out = tuple(
                again_with(again, way.purpose, way.settings) if way.action == "resume" else way
                for way in error.ways_out
                if way.action != "resume" or way.settings
            )
            raise
    return (yield from _to_target(config, outcome, listener))


def continue_run(
    folder: Path,
    make_config: Callable[[RunStore], RunConfig],
    listener: Listener,
    asked: Mapping[str, Any] = MappingProxyType({}),
    *,
    strict: bool = False,
) -> OverlappedRequests[Outcome]:
    """Continue a run, in as many sessions as `budget.target_certified` makes of it; yields as `session.work`.

    Args:
        asked: settings of the call, which ways out repeat.
    """
    config, outcome = yield from _session(folder, make_config, listener, asked, strict=strict)
    return (yield from _to_target(config, outcome, listener, strict=strict))


def outcome_of(session: OverlappedRequests[Outcome]) -> Outcome:
    """What a session returns, for which an engine computes."""
    try:
        next(session)
    except StopIteration as end:
        return end.value
    raise AssertionError("a session with an engine has asked its caller")


def _to_target(
    config: RunConfig, outcome: Outcome, listener: Listener, *, strict: bool = False
) -> OverlappedRequests[Outcome]:
    """Certify the best centre whenever a session has ended for that, and continue: if it reaches the target, no longer
    than until the next session has opened the run."""
    while outcome.reason == TO_CERTIFY:
        certify_best(outcome.run.folder, config, listener.on_notice, listener.on_output)
        _, outcome = yield from _session(outcome.run.folder, lambda store: config, listener, strict=strict)
    return outcome


def _session(
    folder: Path,
    make_config: Callable[[RunStore], RunConfig],
    listener: Listener,
    asked: Mapping[str, Any] = MappingProxyType({}),
    *,
    strict: bool = False,
) -> OverlappedRequests[tuple[RunConfig, Outcome]]:
    """Open a run, check that the config of this session fits it, and work on it."""
    opened = when_free(partial(RunStore.open, folder, hook=listener.hook), telling_once(folder, listener.on_notice))
    with opened as store, in_run(store.meta.run_id):
        # Repairs remain even if the config is refused below, so they are reported now; `work` reports later notices.
        for notice in store.notices:
            listener.on_notice(notice)
        store.notices.clear()
        config = make_config(store)
        require_same_task(config)
        require_episodes(task_of(config), asks_caller=listener.asks_caller)
        require_resumable(store, config, asked, strict=strict)
        try:
            write_config(folder, config.resolved_yaml())
        except OSError as error:
            raise explained(error, folder, f"writing {CONFIG}") from error
        if reason := target_reached(folder, config.budget.target_certified, config.task.fitness):
            return config, Outcome(open_run(folder), reason, is_finished=True)
        if (is_due := due(folder, config))(store.last_history()):
            return config, Outcome(open_run(folder), TO_CERTIFY, is_finished=False)
        with listener.shown(folder) as on_generation:
            listening = on_generation, listener.on_notice, listener.on_compile, listener.on_output
            outcome = yield from work(config, store, *listening, strict=strict, told=listener.told, is_due=is_due)
            return config, outcome
