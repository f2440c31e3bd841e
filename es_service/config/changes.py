"""What changes with a key of a run: the keys that follow from it, the constants of the run; and what cannot change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

from es_service.config.fields import OPTIONS
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
"""What the form and meaning of a run's state depend on: with another value no state of an earlier run can be used."""
ALIKE = ("ns_es", "nsr_es", "nsra_es")
"""Searches with the same state: a fork may go from one to another. Only the weight of fitness, which then begins anew,
tells them apart."""
START_KEYS = ("search.preset", "search.init_from", "policy.init", "search.fitness_weight_start")
"""What is used where a run starts and never again."""
_SHAPES = ("compute.chunk_pairs", "compute.rollout_block_pairs", "compute.gradient_block_pairs")
_MAP = ("map.kind", "map.bounds", "map.cells")
_FOLLOWERS = {
    "task.environment": (OPTIONS, "task.episode_steps", *_MAP, "map.qd_offset"),
    "task.episode_steps": ("map.qd_offset",),
    "task.fitness": ("map.qd_offset",),
    f"{OPTIONS}descriptor": _MAP,
    "map.kind": ("map.cells",),
    "policy.observation_normalization": ("policy.observation_clip",),
    "search.algorithm": ("search.centres",),
    "search.pairs": _SHAPES,
    "compute.chunk_pairs": _SHAPES[1:],
}
"""Key -> how the names of those begin whose values follow from it, unless they are written as well."""
ABSENT = "(absent)"
"""Stands for a constant that only one of two runs has."""


def without_followers(values: Mapping[str, Any], wanted: Mapping[str, Any]) -> dict[str, Any]:
    """Resolved values without those that follow from one that is about to be another."""
    changed = [
        key
        for key in _FOLLOWERS
        if key in wanted and wanted[key] != values.get(key) and not are_alike(key, values.get(key), wanted[key])
    ]
    followers = tuple(name for key in changed for name in _FOLLOWERS[key])
    return {key: value for key, value in values.items() if not key.startswith(followers)}


def are_alike(name: str, old: Any, new: Any) -> bool:
    """Whether a change of a key leaves the state what it is although its key says otherwise."""
    return name == "search.algorithm" and old in ALIKE and new in ALIKE


def does_not_fit(name: str, old: Any, new: Any) -> bool:
    """Whether no state of a run with the old value of a key can be used with the new one."""
    return name in STATE_KEYS and not are_alike(name, old, new)


def foreign_options(values: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """The options of a config's task that mean nothing once another task is wanted instead of it."""
    task = "task.environment"
    if task not in wanted or wanted[task] == values.get(task):
        return []
    return [key for key in values if key.startswith(OPTIONS) and key not in wanted]


def changed_constants(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """Where two results of `constants()` differ: (dotted key, old value, new value), ABSENT where a side lacks it."""
    return [
        (name, old.get(name, ABSENT), new.get(name, ABSENT))
        for name in {**old, **new}
        if old.get(name, ABSENT) != new.get(name, ABSENT)
    ]


def refused_changes(
    run: object, changes: Sequence[tuple[str, Any, Any]], besides: Mapping[str, Any] = MappingProxyType({})
) -> ConfigError:
    """The error for a resume that would change constants of the run: all of them, and the ways out.

    Args:
        run: folder of the run.
        besides: keys that a fork has to set as well, and their values.
    """
    fixed = [name for name, old, new in changes if does_not_fit(name, old, new) or name in START_KEYS]
    forkable = {name: new for name, _, new in changes if name not in fixed and new != ABSENT}
    problems = [Problem(f"{name}: {show(old)} -> {show(new)}", name, new, show(old), old) for name, old, new in changes]
    heading = (
        f"{run}: a run keeps its task, policy, search, novelty, map, seed and chunk shapes for life; this would change:"
    )
    ways = []
    if forkable:
        ways.append(
            WayOut("fork", "go on from its state with other settings", str(run), settings={**forkable, **besides})
        )
    if fixed:
        ways.append(start_afresh(run))
    note = f"a fork has to keep {', '.join(fixed)}" if fixed else ""
    return ConfigError.listing(heading, problems, note, run=run, ways_out=ways)


def start_afresh(run: object) -> WayOut:
    """The way out where the state of a run is of no use with the settings that are wanted."""
    return WayOut("run", "start anew from its centre (same task and network)", settings={"search.init_from": str(run)})
