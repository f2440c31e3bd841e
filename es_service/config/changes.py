"""Changes of a run's config: which values are derived from a changed key, and which changes resume or fork refuses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

from es_service.config.compute import implied_by
from es_service.config.fields import TASK_OPTIONS, as_tuple
from es_service.config.keys import FIELDS
from es_service.config.methods import (
    KIND,
    Methods,
    all_search_fields,
    are_alike,
    filled_in,
    has_effect,
    kinds_without,
    method_problems,
    only_centres,
    parts_of,
    search_fields,
)
from es_service.config.presets import preset_rows
from es_service.config.resolution import LEFT_OPEN
from es_service.config.search import SearchConfig
from es_service.config.yaml_text import show
from es_service.errors import ConfigError, Problem, WayOut

STATE_KEYS = (
    "task.environment",
    "task.options.descriptor",
    "task.descriptor",
    "policy.hidden",
    "policy.activation",
    "policy.memory",
    "policy.output",
    "policy.bias",
    "search.algorithm",
    "search.centres",
    "search.elites.kind",
    "search.elites.estimate",
    "map.enabled",
    "map.kind",
    "map.bounds",
    "map.cells",
    "map.centroids",
)
"""Keys that determine the form and the meaning of a run's state; if one of them changes, the state cannot be used."""
_CHOSEN = {"search.algorithm", "search.preset", "search.init_from"}
"""Keys of which a method has no default of its own."""
START_KEYS = ("search.preset", "search.init_from", "policy.init", "search.fitness_weight_start")
"""Keys that are used only when a run starts."""
_SHAPES = ("compute.chunk_pairs", "compute.rollout_block_pairs", "compute.gradient_block_pairs")
_MAP = ("map.kind", "map.bounds", "map.cells", "map.centroids")
DERIVED_KEYS = {
    "task.environment": ("task.episode_steps", *_MAP, "map.qd_offset"),
    "task.episode_steps": ("map.qd_offset",),
    "task.fitness": ("map.qd_offset",),
    f"{TASK_OPTIONS}descriptor": _MAP,
    "task.descriptor": _MAP,
    "map.kind": ("map.cells", "map.centroids"),
    "policy.observation_normalization": ("policy.observation_clip",),
    "policy.output": ("policy.action_noise",),
    "search.algorithm": ("search.centres",),
    "search.emitters": ("search.centres",),
    "search.screened": ("search.centres",),
    "search.pairs": _SHAPES,
    "compute.chunk_pairs": _SHAPES[1:],
}
"""Key -> prefixes of the keys whose values are derived from it, unless they are set explicitly."""
ABSENT = "(absent)"
"""Stands for the value of a constant that only the other run has."""


def without_derived(values: Mapping[str, Any], wanted: Mapping[str, Any], algorithms: Methods) -> dict[str, Any]:
    """Resolved values without those that are derived from a key which `wanted` is about to change."""
    changed = [
        key
        for key in DERIVED_KEYS
        if key in wanted
        and wanted[key] != values.get(key)
        and not (key == "search.algorithm" and are_alike(values.get(key), wanted[key], algorithms))
    ]
    derived = tuple(name for key in changed for name in DERIVED_KEYS[key])
    return {key: value for key, value in values.items() if not key.startswith(derived)}


def does_not_fit(name: str, old: Any, new: Any, algorithms: Methods) -> bool:
    """Whether a state made with the old value of a key cannot be used with the new value."""
    return name in STATE_KEYS and not (name == "search.algorithm" and are_alike(old, new, algorithms))


def foreign_keys(
    values: Mapping[str, Any], wanted: Mapping[str, Any], settings: type[SearchConfig] | None, algorithms: Methods
) -> dict[str, str]:
    """Keys that go with the task, the algorithm or a part of a config, if `wanted` replaces that and what replaces it
    does not use them, or an algorithm does not allow their values; each with a clause that says what is replaced.

    Args:
        settings: those of the method with `wanted`; None if it is not known.
    """

    def is_replaced(key: str) -> bool:
        return key in wanted and wanted[key] != values.get(key)

    foreign: dict[str, str] = {}
    if is_replaced("task.environment"):
        why = f"{wanted['task.environment']} replaces its task"
        foreign |= {key: why for key in values if key.startswith(TASK_OPTIONS) or key == "task.descriptor"}
    if settings is None:
        return foreign
    chosen = filled_in({**values, **wanted}, settings) | dict(values) | dict(wanted)
    if other := is_replaced("search.algorithm"):
        known = values if ":" in str(values.get("search.algorithm")) else all_search_fields(algorithms)
        known = {*known, *settings.unused}
        why = _replaces("search.algorithm", wanted["search.algorithm"])
        foreign |= {key: why for key in values if key in known and not has_effect(key, settings)}
        forbidden = [problem.field or "" for problem in method_problems(chosen, settings)]
        forbidden += [derived for key in forbidden for derived in DERIVED_KEYS.get(key, ())]
        foreign |= {key: why for key in values if key in forbidden}
    for kind in (f"{part}.{KIND}" for part in parts_of(settings)):
        if other or is_replaced(kind):
            why = _replaces(kind, chosen[kind])
            own = [key for key in values if key.startswith(kind.removesuffix(KIND))]
            foreign |= {key: why for key in own if kinds_without(key, chosen[kind], settings)}
    return {key: why for key, why in foreign.items() if key not in wanted}


def _replaces(key: str, value: Any) -> str:
    return f"{value} replaces its {'algorithm' if key == 'search.algorithm' else key}"


@dataclass(frozen=True)
class KeptValue:
    """A value that a config gives to a key, although what it was written for has been replaced."""

    value: Any
    default: Any
    """What the key would have without it."""
    replaced: str
    """The key that overrides have changed: `search.algorithm`, or the kind of a part."""
    by: str
    """The value of that key now."""

    @property
    def why(self) -> str:
        """What is replaced, as a clause."""
        return _replaces(self.replaced, self.by)


def kept_values(
    values: Mapping[str, Any],
    wanted: Mapping[str, Any],
    settings: type[SearchConfig],
    algorithms: Methods,
    by_task: Mapping[str, Any],
) -> dict[str, KeptValue]:
    """Keys of a config that stay as they are although `wanted` replaces the method, or the kind of a part, for which
    they were written, and that the new one has another default for.

    Args:
        settings: those of the method with `wanted`.
        by_task: values that the task fills in.
    """
    given, before = {**values, **wanted}, filled_in(values, settings) | dict(values)
    filled = dict(by_task) | filled_in({**by_task, **given}, settings)
    methods = (settings, *(method.settings for method in algorithms.values()))
    declared = {*search_fields(settings), *(row.key for method in methods for row in preset_rows(method))} - _CHOSEN
    gone = foreign_keys(values, wanted, settings, algorithms)
    kept: dict[str, KeptValue] = {}
    for key in (key for key in values if key in declared and key not in wanted and key not in gone):
        chosen_by = ("search.algorithm", f"{key.rpartition('.')[0]}.{KIND}")
        replaced = [name for name in chosen_by if wanted.get(name, before.get(name)) != before.get(name)]
        if replaced and has_effect(key, settings):
            default = filled[key] if key in filled else _default_with(key, filled | given, settings)
            if default != ABSENT and as_tuple(values[key]) not in (default, LEFT_OPEN.get(key, ABSENT)):
                kept[key] = KeptValue(values[key], default, replaced[0], show(wanted[replaced[0]]))
    return kept


def _default_with(key: str, chosen: Mapping[str, Any], settings: type[SearchConfig]) -> Any:
    """The default of a key with a method and the chosen kinds of its parts; ABSENT if it has none."""
    if key == "search.centres":
        return only_centres(chosen, settings) or settings.first_centres
    part, _, leaf = key.rpartition(".")
    kinds, kind = parts_of(settings).get(part, {}), chosen.get(f"{part}.{KIND}")
    fields = kinds[kind].model_fields if isinstance(kind, str) and kind in kinds else {}
    field = fields.get(leaf) or search_fields(settings).get(key)
    return _default(key) if field is None else ABSENT if field.is_required() else field.default


def changed_constants(
    old: Mapping[str, Any], new: Mapping[str, Any], defaults: Mapping[str, Any] = MappingProxyType({})
) -> list[tuple[str, Any, Any]]:
    """Differences between two results of `constants()`: (dotted key, old value, new value), ABSENT if missing.

    A key that only `new` has may be younger than the run. It counts as its default, which is what the run has done.
    Keys that only one of two methods has, or of two kinds of a part, go with these and are not listed.

    Args:
        defaults: those of the keys that the task and the search of `new` declare, by key.
    """

    def goes_with_another(name: str) -> bool:
        chosen = ("search.algorithm", f"{name.rpartition('.')[0]}.{KIND}")
        is_shared = name in old and name in new
        return name.startswith("search.") and not is_shared and any(old.get(key) != new.get(key) for key in chosen)

    before = {name: _default(name) for name in new} | dict(defaults) | dict(old)
    return [
        (name, before.get(name, ABSENT), new.get(name, ABSENT))
        for name in {**old, **new}
        if before.get(name, ABSENT) != new.get(name, ABSENT) and not goes_with_another(name)
    ]


def _default(name: str) -> Any:
    """The default of a key; ABSENT for one without a default."""
    return FIELDS[name].default if name in FIELDS and not FIELDS[name].is_required() else ABSENT


def refused_changes(
    run: object,
    changes: Sequence[tuple[str, Any, Any]],
    algorithms: Methods,
    besides: Mapping[str, Any] = MappingProxyType({}),
) -> ConfigError:
    """The error for a resume that would change constants of the run; it lists all of them and the ways out.

    Args:
        changes: (dotted key, old value, new value) of each constant, as `changed_constants` returns them.
        besides: further keys that a fork must set, and their values.
    """
    fixed = [name for name, old, new in changes if does_not_fit(name, old, new, algorithms) or name in START_KEYS]
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
