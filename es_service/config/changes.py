"""Changes of a run's config: which values are derived from a changed key, and which changes resume or fork refuses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from es_service.config.compute import implied_by
from es_service.config.fields import SEARCH_OPTIONS, TASK_OPTIONS
from es_service.config.keys import FIELDS
from es_service.config.method_keys import keys_without_effect
from es_service.config.yaml_text import show
from es_service.errors import ConfigError, Problem, WayOut

STATE_KEYS = (
    "task.environment",
    "task.options.descriptor",
    "policy.hidden",
    "search.algorithm",
    "search.centres",
    "map.enabled",
    "map.kind",
    "map.bounds",
    "map.cells",
)
"""Keys that determine the form and the meaning of a run's state; if one of them changes, the state cannot be used."""
ALIKE = ("ns_es", "nsr_es", "nsra_es")
"""Algorithms whose states have the same form, so that a fork may change from one to another. They differ only in the
weight of fitness, which the fork starts anew."""
START_KEYS = ("search.preset", "search.init_from", "policy.init", "search.fitness_weight_start")
"""Keys that are used only when a run starts."""
_SHAPES = ("compute.chunk_pairs", "compute.rollout_block_pairs", "compute.gradient_block_pairs")
_MAP = ("map.kind", "map.bounds", "map.cells")
_FOLLOWERS = {
    "task.environment": ("task.episode_steps", *_MAP, "map.qd_offset"),
    "task.episode_steps": ("map.qd_offset",),
    "task.fitness": ("map.qd_offset",),
    f"{TASK_OPTIONS}descriptor": _MAP,
    "map.kind": ("map.cells",),
    "policy.observation_normalization": ("policy.observation_clip",),
    "search.algorithm": ("search.centres",),
    "search.emitters": ("search.centres",),
    "search.pairs": _SHAPES,
    "compute.chunk_pairs": _SHAPES[1:],
}
"""Key -> prefixes of the keys whose values are derived from it, unless they are set explicitly."""
ABSENT = "(absent)"
"""Stands for the value of a constant that only the other run has."""


def without_followers(values: Mapping[str, Any], wanted: Mapping[str, Any]) -> dict[str, Any]:
    """Resolved values without those that are derived from a key which is about to change.

    Args:
        values: resolved values of the config.
        wanted: the values that are about to replace some of them.
    """
    changed = [
        key
        for key in _FOLLOWERS
        if key in wanted and wanted[key] != values.get(key) and not are_alike(key, values.get(key), wanted[key])
    ]
    followers = tuple(name for key in changed for name in _FOLLOWERS[key])
    return {key: value for key, value in values.items() if not key.startswith(followers)}


def are_alike(name: str, old: Any, new: Any) -> bool:
    """Whether this change keeps the state usable although its key is in STATE_KEYS: both algorithms are in ALIKE."""
    return name == "search.algorithm" and old in ALIKE and new in ALIKE


def does_not_fit(name: str, old: Any, new: Any) -> bool:
    """Whether a state made with the old value of a key cannot be used with the new value."""
    return name in STATE_KEYS and not are_alike(name, old, new)


def foreign_keys(values: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """Keys that go with the task or the algorithm of a config, if `wanted` chooses another one that does not use them.

    These are the options of the config's own task and search, and keys without effect with the other algorithm.
    """

    def is_replaced(key: str) -> bool:
        return key in wanted and wanted[key] != values.get(key)

    found: list[str] = []
    if is_replaced("task.environment"):
        found += [key for key in values if key.startswith(TASK_OPTIONS)]
    if is_replaced("search.algorithm"):
        idle = keys_without_effect(wanted["search.algorithm"])
        found += [key for key in values if key.startswith(SEARCH_OPTIONS) or key in idle]
    return [key for key in found if key not in wanted]


def changed_constants(
    old: Mapping[str, Any], new: Mapping[str, Any], defaults: Mapping[str, Any] = MappingProxyType({})
) -> list[tuple[str, Any, Any]]:
    """Differences between two results of `constants()`: (dotted key, old value, new value), ABSENT if missing.

    A key that only `new` has may be younger than the run. It counts as its default, which is what the run has done. A
    key without effect with both algorithms makes no difference.

    Args:
        defaults: those of the options that the task and the search of `new` declare, by key.
    """
    idle = keys_without_effect(old.get("search.algorithm")) & keys_without_effect(new.get("search.algorithm"))
    before = {name: _default(name) for name in new} | dict(defaults) | dict(old)
    return [
        (name, before[name], new.get(name, ABSENT))
        for name in {**old, **new}
        if before[name] != new.get(name, ABSENT) and name not in idle
    ]


def _default(name: str) -> Any:
    """The default of a key; ABSENT for one without a default."""
    return FIELDS[name].default if name in FIELDS and not FIELDS[name].is_required() else ABSENT


def refused_changes(
    run: object, changes: Sequence[tuple[str, Any, Any]], besides: Mapping[str, Any] = MappingProxyType({})
) -> ConfigError:
    """The error for a resume that would change constants of the run; it lists all of them and the ways out.

    Args:
        run: folder of the run.
        changes: (dotted key, old value, new value) of each constant, as `changed_constants` returns them.
        besides: further keys that a fork must set, and their values.
    """
    fixed = [name for name, old, new in changes if does_not_fit(name, old, new) or name in START_KEYS]
    forkable = {name: new for name, _, new in changes if name not in fixed and new != ABSENT}
    problems = [Problem(f"{name}: {show(old)} -> {show(new)}", name, new, show(old), old) for name, old, new in changes]
    heading = (
        f"{run}: the task, policy, search, novelty, map, seed and chunk shapes of a run cannot be changed. "
        "The changes that are refused:"
    )
    ways = []
    if forkable:
        ways.append(
            WayOut("fork", "continue from its state with other settings", str(run), settings={**forkable, **besides})
        )
    if fixed:
        ways.append(start_afresh(run))
    note = f"a fork cannot change {', '.join(fixed)} either" if fixed else ""
    return ConfigError.listing(heading, problems, note, run=run, ways_out=ways)


def again_with(call: WayOut, purpose: str, settings: Mapping[str, Any]) -> WayOut:
    """A way out that repeats a call with further settings.

    What the call's engine or cluster implied is left out where the settings choose another.
    """
    implied = {}
    if not settings.keys().isdisjoint(("compute.engine", "compute.address")):
        implied = implied_by(call.settings.get("compute.engine"), call.settings.get("compute.address"))
    asked = {key: value for key, value in call.settings.items() if key not in implied or implied[key] != value}
    return replace(call, purpose=purpose, settings={**asked, **settings})


def start_afresh(run: object) -> WayOut:
    """The way out if the wanted settings cannot use the run's state: a new run that starts from its best policy. Not
    every run has a newest centre."""
    purpose = "start a new run from its best policy (same task and network)"
    return WayOut("run", purpose, settings={"search.init_from": f"{run}:best"})
