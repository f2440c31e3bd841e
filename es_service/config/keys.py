"""The keys of a config: which exist, their values in a file or in overrides, and the problems of unknown ones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from pydantic import BaseModel

from es_service.config.compute import WorkerResources
from es_service.config.fields import RESOURCES, TASK_OPTIONS
from es_service.config.methods import (
    KIND,
    Methods,
    all_search_fields,
    kinds_without,
    methods_with,
    no_effect,
    parts_of,
    search_fields,
)
from es_service.config.model import RunConfig
from es_service.config.problems import nearest, one_of, problem_of
from es_service.config.search import SearchConfig
from es_service.config.yaml_text import in_line, parse_value, plain, show
from es_service.errors import Problem
from es_service.protocol.policy_spec import PolicySpec

SECTIONS = {
    name: field.annotation
    for name, field in RunConfig.model_fields.items()
    if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)
}
"""Name -> class of each section."""
FIELDS = {name: field for name, field in RunConfig.model_fields.items() if name not in SECTIONS} | {
    f"{section}.{name}": field
    for section, model in {**SECTIONS, RESOURCES.removesuffix("."): WorkerResources}.items()
    for name, field in model.model_fields.items()
    if f"{section}.{name}." not in (TASK_OPTIONS, RESOURCES)
}
"""Dotted key -> its field in the model. Keys of single methods are not included, nor options, which tasks declare."""
GROUPS = (*SECTIONS, TASK_OPTIONS.removesuffix("."), RESOURCES.removesuffix("."))
"""Names of sections and of groups inside sections, which hold keys and have no value. Those in `search` are not
included: they belong to methods."""
ALIASES = {
    "population": "search.pairs",
    "popsize": "search.pairs",
    "lr": "search.step.learning_rate",
    "std": "search.sigma",
}
"""Name that other libraries use -> our key."""
SEARCH_OPTIONS = "search.options."
RENAMED = {
    "search.members": "search.centres",
    "search.member_choice": "search.centre_choice",
    "search.learning_rate": "search.step.learning_rate",
    "search.l2": "search.step.l2",
    "search.shaping": "search.shaping.kind",
    "search.top_pairs": "search.shaping.count",
}
"""Name of a key before version 0.13 -> its present name. What was an option of a search is a key of `search`."""
BUDGET = [name for name in FIELDS if name.startswith("budget.")]
"""Keys of which at least one must be set."""


def policy_of(values: Mapping[str, Any], observation_size: int, action_size: int) -> PolicySpec:
    """The policy that values of a config make, by dotted key; keys that are missing have their defaults."""
    names = ("hidden", "activation", "output", "bias", "memory")
    hidden, activation, output, bias, memory = (
        values.get(f"policy.{name}", FIELDS[f"policy.{name}"].default) for name in names
    )
    return PolicySpec((observation_size, *hidden, action_size), activation, output, bias, memory or 0)


def sort_keys(mapping: Mapping[Any, Any], group: str = "") -> tuple[dict[str, Any], set[str], list[Problem]]:
    """Sort the keys of a nested mapping: (values by dotted key, names of groups that are not mappings, problems).

    There is a problem for each key with a dot, and each group that is not a mapping. `key_problems` finds unknown keys.
    """
    values: dict[str, Any] = {}
    unusable: set[str] = set()
    problems: list[Problem] = []
    for key, value in mapping.items():
        name = f"{group}{key}"
        if "." in str(key):
            section, leaf = name.rsplit(".", 1)
            problems.append(problem_of(name, value, f"a key in a file has no dots; write {leaf} inside {section}:"))
        elif isinstance(value, Mapping) and (name in GROUPS or group == "search."):
            below = sort_keys(value, f"{name}.")
            values |= below[0]
            unusable |= below[1]
            problems += below[2]
        elif name in GROUPS:
            unusable.add(name)
            problems.append(problem_of(name, value, _not_a_mapping(name, value)))
        else:
            values[name] = plain(value)
    return values, unusable, problems


def _not_a_mapping(group: str, value: object) -> str:
    hint = f"indent its keys below `{_leaf(group)}:`, or delete the line to use the defaults"
    return f"{show(value)} is not a mapping of keys; {hint}"


def key_problems(
    values: Mapping[str, Any], wanted: Mapping[str, Any], settings: type[SearchConfig] | None, algorithms: Methods
) -> dict[str, Problem]:
    """Key -> problem of each key that a config with this method cannot have.

    Args:
        values: all values of the config by dotted key, with the kind of each part.
        wanted: those of them that overrides have set.
        settings: those of the method; None if it is not known, which allows the keys of every method.
    """
    known = FIELDS | (search_fields(settings) if settings else all_search_fields(algorithms))
    parts = {part: kinds for method in algorithms.values() for part, kinds in parts_of(method.settings).items()}
    problems: dict[str, Problem] = {}
    for key, value in values.items():
        if key in known:
            part = key.rpartition(".")[0]
            if settings and (kinds := kinds_without(key, kind := values.get(f"{part}.{KIND}"), settings)):
                what = f"{show(value)} has no effect with {part}.{KIND} = {kind}; leave it out"
                problems[key] = problem_of(key, value, f"{what} (a key of kind {one_of(kinds)})")
        elif not (key.startswith(TASK_OPTIONS) and _leaf(key) and key.count(".") == 2):
            group = key in (*GROUPS, *parts)
            if key in RENAMED or key.startswith(SEARCH_OPTIONS):
                now = RENAMED.get(key, key.replace(SEARCH_OPTIONS, "search."))
                problems[key] = problem_of(key, value, f"this key is now {now}", suggestion=now)
            elif group and key in wanted:
                first = next((known_key for known_key in known if known_key.startswith(f"{key}.")), f"{key}.NAME")
                what = f"this is a section; set its keys one by one, such as {first}=..."
                problems[key] = problem_of(key, value, what, suggestion=first)
            elif group:
                problems[key] = problem_of(key, value, _not_a_mapping(key, value))
            elif methods_with(key, algorithms) and key.startswith("search."):
                problems[key] = no_effect(key, value, values["search.algorithm"], algorithms)
            else:
                groups = GROUPS if isinstance(value, Mapping) else ()
                problems[key] = _unknown_key(key, (*groups, *known), value)
                if problems[key].suggestion is None:
                    problems[key] = _unknown_key(key, (*groups, *known, *all_search_fields(algorithms)), value)
    return problems


MOST_NAMED = 16
"""Most keys that a message lists."""

Overrides = Iterable[str] | Mapping[str, Any]
"""Changes of a config: strings such as "search.sigma=0.05", with values in YAML, the last one for a key winning; or a
mapping from key to value."""


def parse_overrides(overrides: Overrides) -> tuple[dict[str, Any], list[Problem]]:
    """Values by dotted key, and a problem for each override that cannot be read. Its key need not exist."""
    values: dict[str, Any] = {}
    problems: list[Problem] = []
    if isinstance(overrides, Mapping):
        overrides = [f"{name}={in_line(plain(value))}" for name, value in overrides.items()]
    for override in [overrides] if isinstance(overrides, str) else overrides:
        name, equals, text = (part.strip() for part in override.partition("="))
        where = f"override {override}"
        if not equals or not name or not text:
            example = "write KEY=VALUE, such as search.sigma=0.05"
            hint = "the value is missing; write null for no value" if name and equals else example
            problems.append(Problem(f"{where}: {hint}"))
            continue
        try:
            values[name] = parse_value(text)
        except ValueError as error:
            problems.append(Problem(f"{where}: {error}", name, text))
    return values, problems


def _unknown_key(name: str, candidates: Iterable[str], value: Any) -> Problem:
    """The problem of an unknown key. It suggests the same name in another section, else the most similar key; if there
    is neither, it lists the keys of the section."""
    candidates = dict.fromkeys(candidates)
    section, _, leaf = name.rpartition(".")
    everywhere = {_leaf(key): key for key in candidates}
    near_by = {leaf: key for leaf, key in everywhere.items() if key.rpartition(".")[0] == section}
    exactly = everywhere | ALIASES
    for keys in ({leaf: exactly[leaf]} if leaf in exactly else {}, near_by, everywhere):
        if near := nearest(leaf, keys):
            return problem_of(name, value, f"unknown key; did you mean {keys[near]}?", suggestion=keys[near])
    if siblings := [_leaf(key) for key in (*GROUPS, *candidates) if key.rpartition(".")[0] == section]:
        named, others = siblings[:MOST_NAMED], len(siblings) - MOST_NAMED
        more = f" and {others} others" if others > 0 else ""
        return problem_of(name, value, f"unknown key; {section or 'the top level'} has {', '.join(named)}{more}")
    return problem_of(name, value, f"unknown key; the sections are {', '.join(SECTIONS)}")


def _leaf(name: str) -> str:
    return name.rpartition(".")[2]
