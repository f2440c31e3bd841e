"""Changes of a run's config: what it becomes, and which changes resume or fork refuses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from es_service.config.given import Overrides, Source
from es_service.config.keys import FIELDS, Methods, kind_of
from es_service.config.loading import Known, judge, parse
from es_service.config.model import RunConfig, implied_by, is_constant
from es_service.config.text import show
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
    "map.slots",
    "map.neighbours",
)
"""Keys that determine the form and the meaning of a run's state; if one of them changes, the state cannot be used."""
START_KEYS = ("search.preset", "search.init_from", "policy.init", "search.fitness_weight_start")
"""Keys that are used only when a run starts."""
ABSENT = "(absent)"
"""Stands for the value of a constant that only the other run has."""


def changed_config(
    source: Source,
    overrides: Overrides,
    known: Known,
    *,
    given: Mapping[str, Any] | None = None,
    name: str = "config",
) -> RunConfig:
    """The config of an existing run with some keys changed.

    What the changes leave as it was keeps its resolved value, whatever the defaults of this version are. What they
    change is resolved again from what was given: all values that differ between what is given and the same with the
    changes, both resolved by this version. The caller checks whether the run may change in this way.

    Args:
        source: the resolved config, such as the run's own `config.yaml`. The run that `search.init_from` names need
            not exist any more.
        given: what the config of the run was made from, by dotted key; None: all that `source` says.
        overrides, known, name: as for `read`.

    Raises:
        ConfigError: lists every problem found, as that of `Reading.config`.
    """
    parsed = parse(source, overrides, name)
    if given is None:
        given = parsed.file
    others = {key: value for key, value in parsed.wanted.items() if not is_constant(key)}
    if len(others) < len(parsed.wanted):
        before, after = (
            judge(parsed._replace(file=given, wanted=wanted), known, new=False).values.known()
            for wanted in (others, parsed.wanted)
        )
        affected = {key for key in {**before, **after} if before.get(key, ABSENT) != after.get(key, ABSENT)}
        file = {key: value for key, value in parsed.file.items() if key not in affected}
        parsed = parsed._replace(file=file | {key: value for key, value in given.items() if key in affected})
    reading = judge(parsed, known, new=False)
    remain = {key: value for key, value in given.items() if key not in reading.left_out}
    return replace(reading, given=remain | dict(parsed.wanted)).config()


def does_not_fit(name: str, old: Any, new: Any, algorithms: Methods) -> bool:
    """Whether a state made with the old value of a key cannot be used with the new value."""
    return name in STATE_KEYS and not (name == "search.algorithm" and are_alike(old, new, algorithms))


def are_alike(old: object, new: object, algorithms: Methods) -> bool:
    """Whether two shipped methods are of one family, so that a fork may change from one to the other."""
    families = [method.settings.family for name, method in algorithms.items() if name in (old, new)]
    return old == new or (len(families) == 2 and families[0] == families[1] != "")


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
        chosen = ("search.algorithm", kind_of(name))
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
