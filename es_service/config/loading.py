"""Turns YAML and overrides into a `RunConfig`, or raises one error that lists everything that is wrong with them.

The steps are: read, sort keys into sections, apply overrides, set keys without effect aside, fill in the preset, check
each value alone, check names and options, resolve what is left open, check the sections against each other. A value
that fails a step is reported once and removed, so that the later steps still check everything else.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Mapping
from types import FunctionType, NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import ValidationError
from pydantic.fields import FieldInfo

from es_service.config.changes import KeptValue, foreign_keys, kept_values, without_derived
from es_service.config.fields import TASK_OPTIONS, as_tuple
from es_service.config.keys import BUDGET, FIELDS, SECTIONS, Overrides, key_problems, parse_overrides, sort_keys
from es_service.config.map_rules import map_problems
from es_service.config.methods import (
    KIND,
    Methods,
    all_search_fields,
    filled_in,
    has_effect,
    kinds_without,
    method_problems,
    no_effect,
    parts_of,
    search_fields,
    start_problems,
)
from es_service.config.model import RunConfig
from es_service.config.objective_rules import objective_problems
from es_service.config.options import options_of, read_options, settings_of_task
from es_service.config.problems import meant_task, nearest, not_allowed, one_of, problem_of, wrong_value
from es_service.config.resolution import (
    LEFT_OPEN,
    engine_problems,
    hidden_problems,
    is_idle,
    policy_problems,
    resolve,
    rollout_problems,
    shape_problems,
    task_problems,
    values_of_task,
)
from es_service.config.search import SearchConfig
from es_service.config.shipped import read_config
from es_service.config.start import folder_problems
from es_service.config.tasks import Tasks
from es_service.config.yaml_text import show
from es_service.errors import ConfigError, Problem, counted
from es_service.protocol.messages import TaskSpec, with_options
from es_service.protocol.rollouts import Rollouts
from es_service.protocol.user_code import in_no_file

Source = str | os.PathLike[str] | Mapping[str, Any]
"""Where a config comes from: the path of a YAML file, the name of a shipped one, or the content of one."""


def load_config(
    source: Source,
    overrides: Overrides = (),
    *,
    tasks: Mapping[str, TaskSpec],
    algorithms: Methods,
    rollouts: Rollouts,
    new: bool = True,
    searches: bool = True,
    name: str = "config",
) -> RunConfig:
    """Load the config of a new run.

    Args:
        source: a YAML file, the name of a shipped config, or a nested mapping with the content of one.
        overrides: strings such as "search.sigma=0.05", with values in YAML, the last one for a key winning; or a
            mapping from key to value. If they choose another task or algorithm, keys of the source that go with its
            own one are dropped, and so are values that the chosen algorithm does not allow; `left_out` returns those.
        tasks: the tasks that `task.environment` may name.
        algorithms: the methods that `search.algorithm` may name, of which the first is the simplest.
        rollouts: the rollouts that `compute.rollout` may name.
        new: whether the run that `search.init_from` names, if any, must exist.
        searches: whether a search uses the config; if none does, `search.algorithm` and the budget may be left out.
        name: what an error calls a `source` that is no file.

    Raises:
        ConfigError: names the file, then lists every problem on a line of its own.
    """
    defaults = {} if searches else {"search.algorithm": next(iter(algorithms)), "budget.generations": 1}
    return _load(source, overrides, tasks, algorithms, rollouts, defaults, name, new=new, resolved=False)


def left_out(source: Source, overrides: Overrides, algorithms: Methods) -> dict[str, str]:
    """Keys that `load_config` drops because the overrides choose another task, algorithm or kind of a part, which does
    not use them or allow their values; each with a clause that says so.

    `source` and `overrides` must be ones that `load_config` accepts.
    """
    values, wanted = _given(source, overrides)
    method = algorithms[{**values, **wanted}["search.algorithm"]]
    return foreign_keys(values, wanted, method.settings, algorithms)


def idle_keys(source: Source, overrides: Overrides, algorithms: Methods) -> dict[str, str]:
    """Keys of the overrides that the method of a config, or the chosen kind of a part, does not have; each with the
    name of that method or kind. Nothing if `load_config` cannot read the config or does not know its method."""
    try:
        values, wanted = _given(source, overrides)
        method = str({**values, **wanted}.get("search.algorithm"))
        settings = algorithms[method].settings
    except (KeyError, ConfigError):
        return {}
    chosen = filled_in({**values, **wanted}, settings) | values | wanted
    idle = {key: method for key in wanted if not has_effect(key, settings)}
    for key in wanted:
        kind = f"{key.rpartition('.')[0]}.{KIND}"
        if key not in idle and kinds_without(key, chosen.get(kind), settings):
            idle[key] = f"{kind} = {show(chosen[kind])}"
    return idle


def kept(
    source: Source, overrides: Overrides, *, tasks: Mapping[str, TaskSpec], algorithms: Methods
) -> dict[str, KeptValue]:
    """Keys of a config whose values replace other defaults of the algorithm, or of the kind of a part, that the
    overrides choose in the place of its own.

    Nothing of a config whose algorithm is unknown. Raises ConfigError if `source` cannot be read.
    """
    values, wanted = _given(source, overrides)
    task, method = (str({**values, **wanted}.get(key)) for key in ("task.environment", "search.algorithm"))
    by_task: dict[str, Any] = {}
    with contextlib.suppress(KeyError, ConfigError):
        by_task = values_of_task(_looked_up(tasks, task, values, wanted))
    try:
        return kept_values(values, wanted, algorithms[method].settings, algorithms, by_task)
    except (KeyError, ConfigError):
        return {}


def _given(source: Source, overrides: Overrides) -> tuple[dict[str, Any], dict[str, Any]]:
    """Values by dotted key of a source, and of overrides."""
    mapping = source if isinstance(source, Mapping) else read_config(source)
    return sort_keys(mapping)[0], parse_overrides(overrides)[0]


def _looked_up(known: Mapping[str, Any], name: str, values: Mapping[str, Any], wanted: Mapping[str, Any]) -> Any:
    """The task, with what a config chooses for it, or the method of a name."""
    return known.chosen(name, **settings_of_task(values, wanted)) if isinstance(known, Tasks) else known[name]


def changed_config(
    source: Source,
    overrides: Overrides = (),
    *,
    tasks: Mapping[str, TaskSpec],
    algorithms: Methods,
    rollouts: Rollouts,
    name: str = "config",
) -> RunConfig:
    """The config of an existing run with some keys changed.

    Values that are derived from the changed keys, by a preset or from the task, are resolved again. The caller checks
    whether the run may change in this way. Arguments are as for `load_config`; `source` is a resolved config, such as
    the run's own `config.yaml`. The run that `search.init_from` names need not exist any more.

    Raises:
        ConfigError: as for `load_config`.
    """
    return _load(source, overrides, tasks, algorithms, rollouts, {}, name, new=False, resolved=True)


def _load(
    source: Source,
    overrides: Overrides,
    tasks: Mapping[str, TaskSpec],
    algorithms: Methods,
    rollouts: Rollouts,
    defaults: Mapping[str, Any],
    name: str,
    *,
    new: bool,
    resolved: bool,
) -> RunConfig:
    if isinstance(source, Mapping):
        mapping = source
    else:
        name = os.fspath(source)
        mapping = read_config(name)
    values, unusable, problems = sort_keys(mapping)
    wanted, more = parse_overrides(overrides)
    problems += more
    chosen = {**defaults, **values, **wanted}
    selected: dict[str, Any] = {}
    unknown: list[Problem] = []
    for key, what, known, besides in (
        (
            "task.environment",
            "task",
            tasks,
            "brax:NAME, mujoco:ID, gymnasium:ID, python:module:Class, function:module:name, or module:Class",
        ),
        ("search.algorithm", "algorithm", algorithms, "module:function"),
    ):
        given, allowed = chosen.get(key), f"{one_of(known)}, or {besides}"
        if key not in chosen and key.split(".")[0] not in unusable:
            unknown.append(problem_of(key, None, f"missing; must be {allowed}", allowed=allowed))
        try:
            named = isinstance(given, str) and given != ""
            selected[key] = _looked_up(known, str(given), values, wanted) if named else None
        except KeyError:
            meant = meant_task(str(given), known) if what == "task" else nearest(given, known)
            hint = f"; did you mean {meant}?" if meant else ""
            sentence = f"{key}: {show(given)} is not a known {what}; must be {allowed}{hint}"
            unknown.append(Problem(sentence, key, given, allowed, meant))
        except ConfigError as error:
            where = error.field or key
            sentence = str(error) if error.field else f"{key}: {error}"
            unknown.append(Problem(sentence, where, chosen.get(where)))
    task: TaskSpec | None = selected.get("task.environment")
    method = selected.get("search.algorithm")
    settings: type[SearchConfig] | None = None if method is None else method.settings

    foreign = foreign_keys(values, wanted, settings, algorithms)
    if resolved:
        values = without_derived(values, wanted, algorithms)
    values = {**defaults, **{key: value for key, value in values.items() if key not in foreign}} | wanted
    by_task = {} if task is None else values_of_task(task)
    filled = {} if settings is None or "search" in unusable else by_task | filled_in(by_task | values, settings)
    wrong = key_problems(filled | values, wanted, settings, algorithms)
    problems += wrong.values()
    unused = settings.unused if settings is not None else ()
    idle = {key: value for key, value in values.items() if key in unused or (task and is_idle(key, task))}
    left_open = {key for key, ask in LEFT_OPEN.items() if key in idle or _asks(values.get(key, ask), ask)}
    values = {key: value for key, value in values.items() if key not in {*wrong, *idle, *left_open}}
    values = {key: value for key, value in filled.items() if key not in left_open} | values
    bad = _value_problems(values, settings, algorithms)
    problems += [*bad.values(), *unknown]
    values = {key: value for key, value in values.items() if key not in bad}
    if task is not None:
        read, more = read_options(values, task)
        values = {key: value for key, value in values.items() if not key.startswith(TASK_OPTIONS)} | read
        problems += more
    values = resolve(values, left_open, task, settings, rollouts)
    if task is not None:
        problems += task_problems(values, task) + policy_problems(values, task)
        problems += map_problems(values, task)
        problems += objective_problems(values, with_options(task, options_of(values)))
    if settings is not None:
        problems += _idle_problems(idle, values, algorithms, task) + method_problems(values, settings)
        problems += start_problems(values, settings) if new else []
    problems += rollout_problems(values, task, rollouts) + shape_problems(values) + engine_problems(values, rollouts)
    problems += folder_problems(values) + hidden_problems(values, task, rollouts) if new else []
    if "budget" not in unusable and not bad.keys() & BUDGET and all(values.get(key) is None for key in BUDGET):
        problems.append(problem_of("budget", None, f"this run has no limit; set at least one of {one_of(BUDGET)}"))
    if problems or settings is None:
        count = counted(len(problems), "problem")
        raise ConfigError.listing(f"{name}: {count}", problems)
    nested = _nested(values)
    return RunConfig.model_validate(nested | {"search": settings.model_validate(nested["search"])}).made_for(task)


def _asks(value: object, ask: str | None) -> bool:
    """Whether a value asks for its key to be resolved. A plain `==` would fail for an array in a Python mapping."""
    return value is None if ask is None else isinstance(value, str) and value == ask


def _idle_problems(
    idle: Mapping[str, Any], values: Mapping[str, Any], algorithms: Methods, task: TaskSpec | None
) -> list[Problem]:
    """Problems of values of keys without effect. A value that the key has anyway is none, so that a resolved config can
    be loaded like any other.

    Args:
        idle: keys without effect with the algorithm or the task, and the values given for them.
        values: resolved values, without those of `idle`.
    """
    known = {key: field.default for key, field in FIELDS.items() if not field.is_required()} | dict(values)
    return [
        problem_of(key, value, f"{show(value)} has no effect with {task.name}, which has no policy; leave it out")
        if task is not None and is_idle(key, task)
        else no_effect(key, value, values["search.algorithm"], algorithms, known[key])
        for key, value in idle.items()
        if key in known and not (key in LEFT_OPEN and _asks(value, LEFT_OPEN[key]))
        if not (isinstance(value, int | float | str | list | tuple | None) and as_tuple(value) == known[key])
    ]


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


def _value_problems(
    values: Mapping[str, Any], settings: type[SearchConfig] | None, algorithms: Methods
) -> dict[str, Problem]:
    """Key -> problem for each value that is invalid by itself. Missing keys are not reported here, nor are options.

    Args:
        settings: those of the method; None if it is not known: then those of the method that has most of the keys.
    """
    if settings is None:
        known = [method.settings for method in algorithms.values()]
        settings = max(known, key=lambda candidate: len(values.keys() & search_fields(candidate)))
    fields, parts = FIELDS | all_search_fields(algorithms) | search_fields(settings), parts_of(settings)
    kinds = {key: fields[key].default for part in parts if (key := f"{part}.kind")}
    nested = _nested({key: value for key, value in (kinds | dict(values)).items() if not key.startswith(TASK_OPTIONS)})
    wrong_keys: set[str] = set()
    problems: dict[str, Problem] = {}
    for model, section, mapping in ((RunConfig, (), nested), (settings, ("search",), nested.pop("search"))):
        try:
            model.model_validate(mapping)
        except ValidationError as error:
            for item in error.errors(include_url=False):
                place = [str(component) for component in (*section, *item["loc"])]
                if ".".join(place[:2]) in parts:  # a kind follows, or was wrong
                    place[2:3] = [] if len(place) > 2 else ["kind"]
                if not item["loc"]:  # a rule that the class of a user's search has
                    problems["search"] = problem_of("search", None, item["msg"])
                # Where a value has parts, a location is longer than our key: ("policy", "hidden", 1).
                wrong_keys |= {".".join(place[: k + 1]) for k in range(len(place))}
    return problems | {key: _bad_value(key, value, fields[key]) for key, value in values.items() if key in wrong_keys}


def _bad_value(name: str, value: object, field: FieldInfo) -> Problem:
    """The problem of an invalid value: what is allowed, and how to write what was probably meant."""
    allowed = _allowed(field.annotation, field.metadata)
    if name in LEFT_OPEN:
        allowed = f"{show(LEFT_OPEN[name])} or {allowed}"
    choices = get_args(field.annotation) if get_origin(field.annotation) is Literal else ()
    if isinstance(value, type | FunctionType):
        path = f"{value.__module__}:{value.__qualname__}"
        return not_allowed(name, value, allowed, hint=f"; {in_no_file(path) or f'name it as text: {path}'}")
    return wrong_value(name, value, allowed, choices)


_PLAIN = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}
_LIMITS = (("ge", "at least"), ("gt", "above"), ("le", "at most"), ("lt", "below"))
"""Types and limits that the settings of a user's search may have without the words of `config/fields.py`."""


def _allowed(annotation: Any, metadata: Iterable[object] = ()) -> str:
    """What a type allows, in words: the text in its annotation if there is one, else its literal values."""
    for words in metadata:
        if isinstance(words, str):
            return words
    if annotation in _PLAIN:
        limits = [
            f"{words} {getattr(limit, name):g}" for limit in metadata for name, words in _LIMITS if hasattr(limit, name)
        ]
        return ", ".join([_PLAIN[annotation], *limits])
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _allowed(parts[0], parts[1:])
    if origin in (Union, UnionType):
        return " or ".join(_allowed(part) for part in parts)
    if annotation is NoneType:
        return "null"
    return one_of(parts)
