"""Turns YAML and overrides into a `RunConfig`, or raises one error that lists everything that is wrong with them.

`read` looks at a config once: it sorts what is given by key, leaves out what overrides have replaced, checks each key
and each value alone, finds the values of all other keys (`resolution.py`) and applies the rules (`rules.py`). What is
invalid is reported once, as itself.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

from es_service.config.given import Overrides, Source, by_key, parse_overrides, read_config
from es_service.config.keys import (
    FIELDS,
    KIND,
    SECTIONS,
    Methods,
    all_search_fields,
    has_effect,
    key_problems,
    kind_of,
    lacks,
    no_effect,
    parts_of,
    search_fields,
)
from es_service.config.model import ConfigOrigin, Kept, RunConfig, nested, replaces
from es_service.config.parts import TASK_OPTIONS, as_tuple
from es_service.config.resolution import Unknown, Values, asks
from es_service.config.rules import METHOD_RULES, RULES, START_RULES, TASK_RULES, problems_of, unknown_output
from es_service.config.search import SearchConfig, preset_rows
from es_service.config.tasks import CHOICES, OTHER_TASKS, Tasks, read_options, settings_of_task
from es_service.config.text import meant_task, nearest, one_of, problem_of, show
from es_service.config.values import allowed_words, validator_problems, value_problems
from es_service.errors import ConfigError, Problem, counted
from es_service.protocol.machine import given_path
from es_service.protocol.messages import TaskSpec
from es_service.protocol.rollouts import Rollouts

NORMALISED, CLIP = "policy.observation_normalization", "policy.observation_clip"
_CHOSEN = {"search.algorithm", "search.preset", "search.init_from"}
"""Keys of which a method has no default of its own."""


class Known(NamedTuple):
    """What a config may name."""

    tasks: Mapping[str, TaskSpec]
    algorithms: Methods
    """Methods by name, of which the first is the simplest."""
    rollouts: Rollouts


@dataclass(frozen=True)
class Reading:
    """A config that has been read: its values, and everything that is wrong with them."""

    name: str
    """The file, or what an error calls a config that is none."""
    given: Mapping[str, Any]
    """What the config gives, by dotted key: values of the file, without those left out, and of overrides."""
    wanted: Mapping[str, Any]
    """Values of overrides."""
    left_out: Mapping[str, str]
    """See `ConfigOrigin.left_out`."""
    kept: Mapping[str, Kept]
    """See `ConfigOrigin.kept`."""
    values: Values
    problems: Sequence[Problem]
    task: TaskSpec | None
    settings: type[SearchConfig] | None

    def config(self) -> RunConfig:
        """The config.

        Raises:
            ConfigError: names the file, then lists every problem on a line of its own.
        """
        if self.problems or self.settings is None or self.task is None:
            raise ConfigError.listing(f"{self.name}: {counted(len(self.problems), 'problem')}", self.problems)
        values, given = self.values.known(), dict(self.given)
        if isinstance(start := values["search.init_from"], str):
            # An absolute path, so that the stored config names the same run from every working directory.
            values["search.init_from"] = given["search.init_from"] = os.path.abspath(given_path(start))
        sections = nested(values, SECTIONS)
        config = RunConfig.model_validate(sections | {"search": self.settings.model_validate(sections["search"])})
        if problem := unknown_output(config.search, self.task):
            raise ConfigError.listing(f"{self.name}: 1 problem", [problem])
        return config.made_of(ConfigOrigin(self.values.task, given, self.left_out, self.kept))

    @cached_property
    def idle(self) -> dict[str, str]:
        """Keys of the overrides that the method, or the chosen kind of a part, does not have; each with the name of
        that method or kind. Nothing if the method is not known."""
        if self.settings is None:
            return {}
        method = str(self.values.given["search.algorithm"])
        idle = {key: method for key in self.wanted if not has_effect(key, self.settings)}
        for key in self.wanted:
            if key not in idle and lacks(key, kind := self.values.get(kind_of(key)), self.settings):
                idle[key] = f"{kind_of(key)} = {show(kind)}"
        return idle


def read(
    source: Source,
    overrides: Overrides,
    known: Known,
    *,
    new: bool = True,
    searches: bool = True,
    name: str = "config",
) -> Reading:
    """Read a config.

    Args:
        source: a YAML file, the name of a shipped config, or a nested mapping with the content of one.
        overrides: strings such as "search.sigma=0.05", with values in YAML, the last one for a key winning; or a
            mapping from key to value. If they choose another task or algorithm, keys of the source that go with its
            own one are left out, and so are values that the chosen task or algorithm does not allow.
        new: whether a run is about to start with it; the run that `search.init_from` names must then exist.
        searches: whether a search uses the config; if none does, `search.algorithm` and the budget may be left out.
        name: what an error calls a `source` that is no file.

    Raises:
        ConfigError: the source cannot be read.
    """
    return judge(parse(source, overrides, name), known, new=new, searches=searches)


class Parsed(NamedTuple):
    """What a config and overrides say, by dotted key."""

    name: str
    file: Mapping[str, Any]
    wanted: Mapping[str, Any]
    """Values of overrides."""
    unusable: Collection[str]
    """Names of sections that are no mappings."""
    problems: Sequence[Problem]


def parse(source: Source, overrides: Overrides, name: str) -> Parsed:
    """What a config and overrides say, by dotted key."""
    mapping: Mapping[Any, Any]
    if isinstance(source, Mapping):
        mapping = source
    else:
        name = os.fspath(source)
        mapping = read_config(name)
    file, unusable, problems = by_key(mapping)
    wanted, more = parse_overrides(overrides)
    return Parsed(name, file, wanted, unusable, [*problems, *more])


def judge(parsed: Parsed, known: Known, *, new: bool, searches: bool = True) -> Reading:
    """Read what a config says."""
    name, file, wanted, unusable, problems = parsed
    defaults = {} if searches else {"search.algorithm": next(iter(known.algorithms)), "budget.generations": 1}
    left_out = _of_another_task(file, wanted)
    file = _without(file, left_out)
    given = {**defaults, **file, **wanted}
    task, settings, unknown = _chosen(given, unusable, known)
    if settings is not None:
        if _is_replaced("task.environment", file, wanted) and task is not None:
            left_out |= (refused := _refused_by_task(parsed, file, task, settings, known))
            file, given = _without(file, refused), _without(given, refused)
        chosen = Values(given, task, settings, known.rollouts)
        left_out |= (others := _of_another_method(file, wanted, chosen, settings, known.algorithms))
        file, given = _without(file, others), _without(given, others)
    drafted = Values(given, task, settings, known.rollouts)
    kept = _kept(parsed, drafted, settings, known.algorithms)
    wrong = key_problems(given, wanted, drafted, settings, known.algorithms)
    idle = {key: value for key, value in given.items() if _is_idle(key, task, settings)}
    used = {key: value for key, value in given.items() if key not in {*wrong, *idle} and not asks(key, value)}
    bad = value_problems(used, settings, known.algorithms)
    options, wrong_options = ({}, []) if task is None else read_options(used, task)
    used = {key: value for key, value in used.items() if not key.startswith(TASK_OPTIONS)} | options
    invalid = {*bad, *wrong} | {key for key in FIELDS if key.split(".")[0] in unusable}
    values = Values(used, task, settings, known.rollouts, invalid)
    missing = [
        problem_of(key, None, f"missing; must be {allowed_words(field.annotation, field.metadata)}")
        for key, field in values.missing.items()
    ]
    problems = [
        *problems,
        *wrong.values(),
        *bad.values(),
        *unknown,
        *wrong_options,
        *missing,
        *validator_problems(values),
        *_idle_problems(idle, values, known.algorithms, task),
        *problems_of(values, (*RULES, *START_RULES) if new else RULES),
    ]
    return Reading(name, file | dict(wanted), wanted, left_out, kept, values, problems, task, settings)


def _without(values: Mapping[str, Any], left_out: Collection[str]) -> dict[str, Any]:
    return {key: value for key, value in values.items() if key not in left_out}


def _chosen(
    chosen: Mapping[str, Any], unusable: Collection[str], known: Known
) -> tuple[TaskSpec | None, type[SearchConfig] | None, list[Problem]]:
    """The task and the settings of the method that a config names, None where it names none, and the problems."""

    def task_of_name(name: str) -> TaskSpec:
        tasks = known.tasks
        return tasks.chosen(name, **settings_of_task(chosen)) if isinstance(tasks, Tasks) else tasks[name]

    found: list[Any] = []
    problems: list[Problem] = []
    for key, what, names, look_up, besides in (
        ("task.environment", "task", known.tasks, task_of_name, OTHER_TASKS),
        ("search.algorithm", "algorithm", known.algorithms, known.algorithms.__getitem__, "module:function"),
    ):
        given, allowed = chosen.get(key), f"{one_of(names)}, or {besides}"
        found.append(None)
        if key not in chosen and key.split(".")[0] not in unusable:
            problems.append(problem_of(key, None, f"missing; must be {allowed}", allowed=allowed))
        try:
            if isinstance(given, str) and given != "":
                found[-1] = look_up(given)
        except KeyError:
            meant = meant_task(str(given), names) if what == "task" else nearest(given, names)
            hint = f"; did you mean {meant}?" if meant else ""
            sentence = f"{show(given)} is not a known {what}; must be {allowed}{hint}"
            problems.append(problem_of(key, given, sentence, suggestion=meant, allowed=allowed))
        except ConfigError as error:
            if error.ways_out:  # what is not installed, without which its keys are not known
                raise
            where = error.field or key
            sentence = str(error) if error.field else f"{key}: {error}"
            problems.append(Problem(sentence, where, chosen.get(where), suggestion=error.suggestion))
    task, method = found
    return task, None if method is None else method.settings, problems


def _is_replaced(key: str, file: Mapping[str, Any], wanted: Mapping[str, Any]) -> bool:
    return key in wanted and wanted[key] != file.get(key)


def _of_another_task(file: Mapping[str, Any], wanted: Mapping[str, Any]) -> dict[str, str]:
    """See `ConfigOrigin.left_out`: what goes with a task that overrides replace."""
    if not _is_replaced("task.environment", file, wanted):
        return {}

    def is_of_task(key: str) -> bool:
        is_target = key.startswith("budget.target_") and file[key] is not None  # a fitness, which is that of its task
        return is_target or key.startswith(TASK_OPTIONS) or key in CHOICES

    return {key: _replaces_task(wanted) for key in file if key not in wanted and is_of_task(key)}


def _replaces_task(wanted: Mapping[str, Any]) -> str:
    return f"{wanted['task.environment']} replaces its task"


def _refused_by_task(
    parsed: Parsed, file: Mapping[str, Any], task: TaskSpec, settings: type[SearchConfig], known: Known
) -> dict[str, str]:
    """See `ConfigOrigin.left_out`: values that a task allowed which overrides replace, and the new one does not, such
    as noise on actions that are now choices; and bounds of the map, which are in units of the old descriptor.

    A value that is wrong with the old task, too, is left to be reported.
    """
    why = _replaces_task(parsed.wanted)
    said = {key: value for key, value in {**file, **parsed.wanted}.items() if not asks(key, value)}
    invalid = value_problems(said, settings, known.algorithms)
    movable = said.keys() - parsed.wanted.keys() - invalid.keys()

    def refused(values: Values) -> set[str]:
        return {str(problem.field) for problem in problems_of(values, TASK_RULES)} & movable

    def gone(key: str) -> bool:
        return key == "map.bounds" or (key in FIELDS and _is_idle(key, task, None))

    left_out = {key: why for key in said if key in movable and gone(key)}
    while True:  # one such value may hide another
        values = Values(_without(said, left_out), task, settings, known.rollouts, invalid)
        more = refused(values).difference(left_out)
        if more:
            more -= refused(_before(parsed, task, settings, known, invalid))
        if not more:
            break
        left_out |= {key: why for key in said if key in more}
    kinds = {key: values[key] for key in left_out if key.endswith(f".{KIND}")}
    of_them = [key for key in movable if kind_of(key) in kinds and lacks(key, kinds[kind_of(key)], settings)]
    return left_out | dict.fromkeys(of_them, why)


def _before(
    parsed: Parsed, new: TaskSpec, settings: type[SearchConfig], known: Known, invalid: Collection[str]
) -> Values:
    """Values with the task of the file, and with those overrides that are not about the new task, as an output is by
    which actions are chosen."""
    of_new = ("task.", "policy.output") if new.discrete_actions else ("task.",)
    others = {key: value for key, value in parsed.wanted.items() if not key.startswith(of_new)}
    given = {key: value for key, value in {**parsed.file, **others}.items() if not asks(key, value)}
    task = None
    with contextlib.suppress(ConfigError):  # it is not installed here
        task, _, _ = _chosen(given, (), known)
    return Values(given, task, settings, known.rollouts, invalid)


def _of_another_method(
    file: Mapping[str, Any],
    wanted: Mapping[str, Any],
    chosen: Values,
    settings: type[SearchConfig],
    algorithms: Methods,
) -> dict[str, str]:
    """See `ConfigOrigin.left_out`: what goes with a method, or with the kind of a part, that overrides replace."""
    left_out: dict[str, str] = {}
    if other := _is_replaced("search.algorithm", file, wanted):
        known = file if ":" in str(file.get("search.algorithm")) else all_search_fields(algorithms)
        forbidden = {problem.field for problem in problems_of(chosen, METHOD_RULES)}
        forbidden |= {CLIP} if NORMALISED in forbidden else set()  # the bound is in standard deviations
        gone = {key for key in (*known, *settings.unused) if not has_effect(key, settings)} | forbidden
        left_out |= {key: replaces("search.algorithm", wanted["search.algorithm"]) for key in file if key in gone}
    for kind in (f"{part}.{KIND}" for part in parts_of(settings)):
        if other or _is_replaced(kind, file, wanted):
            why, its = replaces(kind, chosen[kind]), [key for key in file if kind_of(key) == kind]
            left_out |= {key: why for key in its if lacks(key, chosen[kind], settings)}
    return _without(left_out, wanted)


def _kept(parsed: Parsed, chosen: Values, settings: type[SearchConfig] | None, algorithms: Methods) -> dict[str, Kept]:
    """See `ConfigOrigin.kept`."""
    kept: dict[str, Kept] = {}
    before = chosen.of(parsed.file)
    choices = [key for key in parsed.wanted if key == "search.algorithm" or key.endswith(f".{KIND}")]
    replaced = {key for key in choices if parsed.wanted[key] != before.get(key)}
    if settings is None or not replaced:
        return kept
    rows = (row for of in (settings, *(method.settings for method in algorithms.values())) for row in preset_rows(of))
    declared = {*search_fields(settings), *(row.key for row in rows)} - _CHOSEN
    for key, value in chosen.given.items():
        by = next((name for name in ("search.algorithm", kind_of(key)) if name in replaced), None)
        if by is None or key in parsed.wanted or key not in declared or not has_effect(key, settings):
            continue
        with contextlib.suppress(Unknown):
            default = chosen.of({name: given for name, given in chosen.given.items() if name != key})[key]
            if not asks(key, value) and as_tuple(value) != default:
                kept[key] = Kept(value, default, by, show(parsed.wanted[by]))
    return kept


def _is_idle(key: str, task: TaskSpec | None, settings: type[SearchConfig] | None) -> bool:
    """Whether a key has no effect with a method, or with a task that has no policy."""
    of_policy = key.startswith("policy.") or key in ("task.episode_steps", "task.descriptor")
    return (settings is not None and key in settings.unused) or (
        task is not None and task.parameters is not None and of_policy
    )


def _same(given: Any, value: Any) -> bool:
    """Whether a value that a config gives, perhaps with lists, is one that it has, with tuples in their place."""
    if isinstance(given, list | tuple) and isinstance(value, tuple):
        return len(given) == len(value) and all(map(_same, given, value))
    return given == value


def _idle_problems(
    idle: Mapping[str, Any], values: Values, algorithms: Methods, task: TaskSpec | None
) -> list[Problem]:
    """Problems of values of keys without effect. A value that the key has anyway is none, so that a resolved config can
    be loaded like any other.

    Args:
        idle: keys without effect with the method or the task, and the values given for them.
        values: those of the config without these.
    """
    problems = []
    for key, value in idle.items():
        is_plain = isinstance(value, int | float | str | list | tuple | None)
        if asks(key, value) or key not in values or (is_plain and _same(value, values[key])):
            continue
        if task is not None and _is_idle(key, task, None):
            what = f"{show(value)} has no effect with {task.name}, which has no policy; leave it out"
            problems.append(problem_of(key, value, what))
        else:
            problems.append(no_effect(key, value, values["search.algorithm"], algorithms, values[key]))
    return problems
