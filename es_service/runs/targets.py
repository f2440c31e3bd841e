"""When a run is over because a certified policy reaches `budget.target_certified`.

The best centre of a run is the best of many noisy evaluations, so that it reaches a target by luck as well. A session
therefore ends when the best centre seems to reach it; new episodes then decide whether it does. If it does not, the run
continues until a better one seems to.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from es_service.config.model import RunConfig
from es_service.loop.interfaces import Stop
from es_service.runs.certification import certify_run
from es_service.runs.certified import EPISODES, certified_policies

BEST = "best"
"""Name of the best centre among the candidates of a certification."""
TO_CERTIFY = "the best centre may have reached budget.target_certified"
"""Reason of the Stop that ends a session before a certification."""


def certify_best(folder: Path, config: RunConfig, on_notice: Callable[[str], None]) -> None:
    """Certify the best centre of a run that no driver holds."""
    workers = None if config.compute.workers == "auto" or config.compute.address else config.compute.workers
    certify_run(folder, best=True, top=0, workers=workers, on_notice=on_notice)


def until_due(
    on_generation: Callable[[Mapping[str, Any]], object], is_due: Callable[[Mapping[str, Any]], bool]
) -> Callable[[Mapping[str, Any]], object]:
    """`on_generation`, whose answer is a Stop once the best centre is to be certified.

    Args:
        is_due: what `due` returns.
    """

    def answer(row: Mapping[str, Any]) -> object:
        given = on_generation(row)
        return Stop(TO_CERTIFY) if not isinstance(given, Stop) and is_due(row) else given

    return answer


def due(folder: Path, config: RunConfig) -> Callable[[Mapping[str, Any] | None], bool]:
    """Function that says of a row of the history whether the best centre is to be certified.

    That is when its stored fitness reaches the target and exceeds that of every best centre that was certified before.
    It is so after an interruption, too: a session begins with the certification to which the one before did not come.
    """
    target = config.budget.target_certified
    if target is None:
        return lambda row: False
    certified = [policy for policy in certified_policies(folder) if policy.episodes.count >= EPISODES]
    tested = [policy.stored_fitness for policy in certified if policy.name == BEST]
    most = max((fitness for fitness in tested if fitness is not None), default=-math.inf)
    return lambda row: row is not None and row["best_fitness"] >= target and row["best_fitness"] > most
