"""When a run is over because its best centre reaches `budget.target_certified`.

The best centre of a run is the best of many noisy evaluations, so that it reaches a target by luck as well. A session
therefore ends when the best centre seems to reach it, and new episodes decide whether it does. If it does not, the run
continues until a better one seems to. A run that decides often passes by luck as well, and the episodes with which a
policy has passed are too good on average. They are therefore not its value: after a pass, further episodes are, which
decide nothing. The run is over even if they lie below the target.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from es_service.config.model import RunConfig
from es_service.loop.interfaces import Stop
from es_service.protocol.content import Policy
from es_service.protocol.noise import Domain
from es_service.runs.certification import Named, add_certified, different, opened, platform_of, workers_for
from es_service.runs.certified import (
    EPISODES,
    Certified,
    all_certifications,
    decisions,
    measure_of,
    passed,
    report_of,
)
from es_service.runs.evaluation import candidates
from es_service.runs.selection import Episodes, new_episodes
from es_service.runs.view import open_run

BEST = "best"
"""Name of the best centre among the candidates of a certification."""
TO_CERTIFY = "the best centre may have reached budget.target_certified"
"""Reason of the Stop that ends a session before a certification."""


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

        def episodes_of(policy: Policy, number: int, domain: Domain) -> Episodes:
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
    best: Named,
    number: int,
    target: float,
    fitness: str,
    platform: Mapping[str, Any],
    episodes_of: Callable[[Policy, int, Domain], Episodes],
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


def until_due(
    on_generation: Callable[[Mapping[str, Any]], object], is_due: Callable[[Mapping[str, Any]], bool]
) -> Callable[[Mapping[str, Any]], object]:
    """`on_generation`, whose answer is a Stop once the best centre is to be certified.

    Args:
        is_due: what `due` returns.
    """

    def answer(row: Mapping[str, Any]) -> object:
        given = on_generation(row)
        if isinstance(given, Stop) or not is_due(row):
            return given
        return Stop(TO_CERTIFY, given if isinstance(given, Mapping) else {})

    return answer


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
