"""Turns YAML and overrides into a `RunConfig`, or raises one error that lists everything that is wrong with them.

The steps are: read, sort keys into sections, apply overrides, set keys without effect aside, fill in the preset, check
each value alone, check names and options, resolve what is left open, check the sections against each other. A value
that fails a step is reported once and removed, so that the later steps still check everything else.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from types import FunctionType, NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import ValidationError

from es_service.config.changes import foreign_keys, without_followers
from es_service.config.fields import OPTION_GROUPS, SEARCH_OPTIONS, TASK_OPTIONS
from es_service.config.keys import BUDGET, FIELDS, SECTIONS, Overrides, parse_overrides, sort_keys
from es_service.config.map_rules import map_problems
from es_service.config.method_keys import keys_without_effect, no_effect
from es_service.config.method_rules import method_problems
from es_service.config.model import RunConfig
from es_service.config.options import read_options
from es_service.config.presets import PRESETS, preset_values
from es_service.config.problems import nearest, not_allowed, one_of, unfit, wrong_value
from es_service.config.resolution import (
    LEFT_OPEN,
    engine_problems,
    policy_problems,
    resolve,
    rollout_problems,
    shape_problems,
    task_problems,
)
from es_service.config.shipped import read_config
from es_service.config.start import folder_problems
from es_service.config.yaml_text import show
from es_service.errors import ConfigError, Problem
from es_service.protocol.messages import TaskSpec
from es_service.protocol.user_code import in_no_file

Source = str | os.PathLike[str] | Mapping[str, Any]
"""Where a config comes from: the path of a YAML file, the name of a shipped one, or the content of one."""
WITHOUT_SEARCH = {"search.algorithm": "es", "budget.generations": 1}
"""Values of a config that no search uses, where it leaves out what only a search needs."""


def load_config(
    source: Source,
    overrides: Overrides = (),
    *,
    tasks: Mapping[str, TaskSpec],
    algorithms: Mapping[str, object],
    no_vectors: str = "",
    new: bool = True,
    searches: bool = True,
) -> RunConfig:
    """Load the config of a new run.

    Args:
        source: a YAML file, the name of a shipped config, or a nested mapping with the content of one.
        overrides: strings such as "search.sigma=0.05", with values in YAML, the last one for a key winning; or a
            mapping from key to value. If they choose another task or algorithm, keys of the source that go with its
            own one are dropped; `left_out` returns those.
        tasks: the tasks that `task.environment` may name.
        algorithms: the algorithms that `search.algorithm` may name; one may declare `options`.
        no_vectors: why this machine's processor cannot run the code that simd compiles; empty if it can.
        new: whether the run that `search.init_from` names, if any, must exist.
        searches: whether a search uses the config; if none does, `search.algorithm` and the budget may be left out.

    Raises:
        ConfigError: names the file, then lists every problem on a line of its own.
    """
    defaults = {} if searches else WITHOUT_SEARCH
    return _load(source, overrides, tasks, algorithms, no_vectors, defaults, new=new, resolved=False)


def left_out(source: Source, overrides: Overrides) -> list[str]:
    """Keys that `load_config` drops because the overrides choose another task or algorithm, which does not use them.

    `source` and `overrides` must be ones that `load_config` accepts.
    """
    mapping = source if isinstance(source, Mapping) else read_config(source)
    return foreign_keys(sort_keys(mapping)[0], parse_overrides(overrides)[0])


def changed_config(
    source: Source,
    overrides: Overrides = (),
    *,
    tasks: Mapping[str, TaskSpec],
    algorithms: Mapping[str, object],
    no_vectors: str = "",
) -> RunConfig:
    """The config of an existing run with some keys changed.

    Values that are derived from the changed keys, by a preset or from the task, are resolved again. The caller checks
    whether the run may change in this way. Arguments are as for `load_config`; `source` is a resolved config, such as
    the run's own `config.yaml`. The run that `search.init_from` names need not exist any more. A key without effect is
    refused only if an override changes it, since versions up to 0.11 recorded any value.

    Raises:
        ConfigError: as for `load_config`.
    """
    return _load(source, overrides, tasks, algorithms, no_vectors, {}, new=False, resolved=True)


def _load(
    source: Source,
    overrides: Overrides,
    tasks: Mapping[str, TaskSpec],
    algorithms: Mapping[str, object],
    no_vectors: str,
    defaults: Mapping[str, Any],
    *,
    new: bool,
    resolved: bool,
) -> RunConfig:
    if isinstance(source, Mapping):
        name, mapping = "config", source
    else:
        name = os.fspath(source)
        mapping = read_config(name)
    values, unusable, problems = sort_keys(mapping)
    wanted, more = parse_overrides(overrides)
    problems += more
    if resolved:
        values = without_followers(values, wanted)
    foreign = foreign_keys(values, wanted)
    values = {**defaults, **{key: value for key, value in values.items() if key not in foreign}}
    recorded = values if resolved else {}
    values = values | wanted
    without_effect = keys_without_effect(values.get("search.algorithm"))
    idle = {key: value for key, value in values.items() if key in without_effect}
    values = {key: value for key, value in values.items() if key not in idle}
    values |= {key: recorded[key] for key in idle if key in recorded}  # their values stay what they were

    left_open = {key for key, ask in LEFT_OPEN.items() if _asks(values.get(key, ask), ask)}
    values = {key: value for key, value in values.items() if key not in left_open}
    if "search" not in unusable:
        values = _preset_values(values) | values
    bad = _value_problems(values)
    problems += bad.values()
    values = {key: value for key, value in values.items() if key not in bad}

    found: dict[str, Any] = {}
    for key, what, known, besides in (
        ("task.environment", "task", tasks, "brax:NAME, or module:Class"),
        ("search.algorithm", "algorithm", algorithms, "module:function"),
    ):
        chosen = values.get(key)
        try:
            found[key] = known[chosen] if chosen is not None else None
        except KeyError:
            allowed, meant = f"{one_of(known)}, or {besides}", nearest(chosen, known)
            hint = f"; did you mean {meant}?" if meant else ""
            sentence = f"{key}: {show(chosen)} is not a known {what}; must be {allowed}{hint}"
            problems.append(Problem(sentence, key, chosen, allowed, meant))
        except ConfigError as error:
            problems.append(Problem(f"{key}: {error}", key, chosen))
        if chosen is None and key not in bad and key.split(".")[0] not in unusable:
            problems.append(unfit(key, None, f"missing; must be {one_of(known)}", allowed=one_of(known)))
    task: TaskSpec | None = found.get("task.environment")
    declared = {} if task is None else {TASK_OPTIONS: (task.name, task.options)}
    if "search.algorithm" in values.keys() & found.keys():
        declared[SEARCH_OPTIONS] = values["search.algorithm"], getattr(found["search.algorithm"], "options", {})
    for group, (owner, options) in declared.items():
        read, wrong = read_options(values, group, owner, options)
        values = {key: value for key, value in values.items() if not key.startswith(group)} | read
        problems += wrong
    values = resolve(values, left_open, task, no_vectors)
    if task is not None:
        problems += task_problems(values, task) + policy_problems(values, task)
        problems += map_problems(values, task) + rollout_problems(values, task)
    problems += _idle_problems(idle, values)
    problems += method_problems(values) + shape_problems(values) + engine_problems(values)
    problems += folder_problems(values) if new else []
    if "budget" not in unusable and not bad.keys() & BUDGET and all(values.get(key) is None for key in BUDGET):
        problems.append(unfit("budget", None, f"this run has no limit; set at least one of {one_of(BUDGET)}"))
    if problems:
        count = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
        raise ConfigError.listing(f"{name}: {count}", problems)
    config = RunConfig.model_validate(_nested(values))
    return config.made_for(task, declared.get(SEARCH_OPTIONS, ("", {}))[1])


def _asks(value: object, ask: str | None) -> bool:
    """Whether a value asks for its key to be resolved. A plain `==` would fail for an array in a Python mapping."""
    return value is None if ask is None else isinstance(value, str) and value == ask


def _idle_problems(idle: Mapping[str, Any], values: Mapping[str, Any]) -> list[Problem]:
    """Problems of values of keys without effect. A value that the key has anyway is none, so that a resolved config can
    be loaded like any other.

    Args:
        idle: keys without effect with the algorithm, and the values given for them.
        values: resolved values, without those of `idle`.
    """
    known = {key: field.default for key, field in FIELDS.items() if not field.is_required()} | dict(values)
    return [
        no_effect(key, value, values["search.algorithm"], known[key])
        for key, value in idle.items()
        if key in known and not (key in LEFT_OPEN and _asks(value, LEFT_OPEN[key]))
        if not (isinstance(value, int | float | str | None) and value == known[key])
    ]


def _preset_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values of the config's preset; empty if the preset is unknown, which is reported as a bad value."""
    preset = values.get("search.preset", FIELDS["search.preset"].default)
    if not isinstance(preset, str) or preset not in PRESETS:
        return {}
    filled = preset_values(preset, values.get("search.algorithm"))
    normalised = "policy.observation_normalization"
    if values.get(normalised, filled.get(normalised)) is False:
        filled["policy.observation_clip"] = None  # the bound is in standard deviations, which are then unknown
    return filled


def _nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Nested mappings from dotted keys, the inverse of `flat`; every section is present, even if empty."""
    nested: dict[str, Any] = {section: {} for section in SECTIONS}
    for name, value in values.items():
        *path, leaf = name.split(".")
        target = nested
        for group in path:
            target = target.setdefault(group, {})
        target[leaf] = value
    return nested


def _value_problems(values: Mapping[str, Any]) -> dict[str, Problem]:
    """Key -> problem for each value that is invalid by itself. Missing keys are not reported here, nor are options."""
    values = {key: value for key, value in values.items() if not key.startswith(OPTION_GROUPS)}
    try:
        RunConfig.model_validate(_nested(values))
    except ValidationError as error:
        found = [item["loc"] for item in error.errors(include_url=False)]
    else:
        return {}
    # Where a value has parts, a location is longer than our key: ("policy", "hidden", 1).
    names = {n for loc in found for k in range(len(loc)) if (n := ".".join(map(str, loc[: k + 1]))) in values}
    return {name: _bad_value(name, value) for name, value in values.items() if name in names}


def _bad_value(name: str, value: object) -> Problem:
    """The problem of an invalid value: what is allowed, and how to write what was probably meant."""
    field = FIELDS[name]
    allowed = _allowed(field.annotation, field.metadata)
    if name in LEFT_OPEN:
        allowed = f"{show(LEFT_OPEN[name])} or {allowed}"
    choices = get_args(field.annotation) if get_origin(field.annotation) is Literal else ()
    if isinstance(value, type | FunctionType):
        path = f"{value.__module__}:{value.__qualname__}"
        return not_allowed(name, value, allowed, hint=f"; {in_no_file(path) or f'name it as text: {path}'}")
    return wrong_value(name, value, allowed, choices)


def _allowed(annotation: Any, metadata: Iterable[object] = ()) -> str:
    """What a type allows, in words: the text in its annotation if there is one, else its literal values."""
    for words in metadata:
        if isinstance(words, str):
            return words
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _allowed(parts[0], parts[1:])
    if origin in (Union, UnionType):
        return " or ".join(_allowed(part) for part in parts)
    if annotation is NoneType:
        return "null"
    return one_of(parts)
