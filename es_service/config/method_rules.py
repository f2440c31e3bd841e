"""Rules for settings that depend on the method, `search.algorithm`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from es_service.config.problems import not_allowed
from es_service.errors import Problem

CENTRES = 5
"""Default number of centres of ns_es, nsr_es and nsra_es (the meta-population of Conti et al. 2018). Source:
deep-neuroevolution's Humanoid settings and the released ME-ES code."""
FIRST_POLICIES = 32
"""Default number of centres of map_elites, which are the random policies that begin the map. Our own choice: the store
keeps all of them, and for an ant each takes a megabyte."""


def default_centres(values: Mapping[str, Any]) -> int:
    """Number of centres for `search.centres: auto`."""
    algorithm = values["search.algorithm"]
    others = {"map_elites": FIRST_POLICIES}.get(algorithm, 1 if ":" in algorithm else CENTRES)
    return _only_centres(algorithm, values) or others


def method_problems(values: Mapping[str, Any]) -> list[Problem]:
    """Problems of settings that the algorithm does not support."""
    algorithm, problems = values.get("search.algorithm"), []
    centres, only = values.get("search.centres"), _only_centres(algorithm, values)
    if only is not None and centres not in (None, only):
        why = f" for {algorithm}, which has one centre{' per emitter' if algorithm in ('me_es', 'memes') else ''}"
        problems.append(not_allowed("search.centres", centres, f"{only} or auto", why=why))
    if algorithm == "map_elites" and values.get("policy.observation_normalization") is True:
        why = " for map_elites, which has no training episodes to gather statistics from"
        problems.append(not_allowed("policy.observation_normalization", True, "false", why=why))
    return problems


def map_needed_by(values: Mapping[str, Any]) -> str:
    """What the algorithm needs a map for; empty if it needs none."""
    return {
        "me_es": "whose blocks start from elites of the map",
        "memes": "whose emitters begin again from elites of the map",
        "map_elites": "whose policies descend from elites of the map",
    }.get(str(values.get("search.algorithm")), "")


def _only_centres(algorithm: object, values: Mapping[str, Any]) -> int | None:
    """The only number of centres that an algorithm supports; None if it supports any."""
    emitters = values.get("search.emitters", 1)
    return {"es": 1, "ars": 1, "me_es": emitters, "memes": emitters}.get(str(algorithm))
