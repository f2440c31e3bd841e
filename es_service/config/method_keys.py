"""Which keys of a config only some of the methods use: the one table from which errors and guides say so.

A key that no method names here has an effect with every method. A test changes each key with each method, and compares
what the run then does with this table. A search of the user may use any key.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from es_service.config.problems import one_of, unfit
from es_service.config.yaml_text import show
from es_service.errors import Problem

_POPULATIONS = (
    "task.episodes_per_member",
    "policy.action_noise",
    "search.pairs",
    "search.sigma",
    "search.learning_rate",
    "search.l2",
    "search.common_random_numbers",
    "compute.chunk_pairs",
    "compute.rollout_block_pairs",
    "compute.gradient_block_pairs",
)
"""Keys of methods that perturb a centre with pairs of noise and move it along a gradient estimate."""
_RANKED = (*_POPULATIONS, "search.shaping")
_CENTRES = (*_RANKED, "search.update", "search.centre_choice")
_EMITTERS = (*_RANKED, "search.emitters", "search.mode", "search.parent_statistics")

METHOD_KEYS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "es": _RANKED,
        "ns_es": _CENTRES,
        "nsr_es": _CENTRES,
        "nsra_es": (
            *_CENTRES,
            "search.fitness_weight_start",
            "search.fitness_weight_step",
            "search.fitness_weight_patience",
            "search.fitness_weight_min_gain",
        ),
        "me_es": (
            *_EMITTERS,
            "search.alternation",
            "search.first_block",
            "search.block_generations",
            "search.cell_sampling",
        ),
        "memes": (*_EMITTERS, "search.stagnation_generations"),
        "map_elites": ("search.batch", "search.iso_sigma", "search.line_sigma"),
        "ars": (*_POPULATIONS, "search.top_pairs"),
    }
)
"""Method -> its keys among those that not every method uses."""
SOME_METHODS = tuple(dict.fromkeys(key for keys in METHOD_KEYS.values() for key in keys))
"""All keys of the table."""


def methods_with(key: str) -> tuple[str, ...]:
    """The methods that use a key of SOME_METHODS."""
    return tuple(method for method, keys in METHOD_KEYS.items() if key in keys)


def keys_without_effect(method: object) -> frozenset[str]:
    """The keys that have no effect with a method; none for a search of the user."""
    return frozenset(SOME_METHODS).difference(METHOD_KEYS.get(str(method), SOME_METHODS))


def no_effect(key: str, value: Any, method: str, default: Any) -> Problem:
    """The problem of a key that has no effect with a method.

    Args:
        default: the value that the key has if it is left out.
    """
    others = one_of(methods_with(key), "and")
    what = f"{show(value)} has no effect with {method}; leave it out (a key of {others})"
    return unfit(key, value, what, suggestion=default)
