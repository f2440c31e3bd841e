"""The keys of a config: which exist, their values in a file or in overrides, and the problems of unknown ones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from pydantic import BaseModel

from es_service.config.compute import WorkerResources
from es_service.config.fields import OPTION_GROUPS, RESOURCES
from es_service.config.model import RunConfig
from es_service.config.problems import nearest, unfit
from es_service.config.yaml_text import in_line, parse_value, show
from es_service.errors import Problem

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
    if f"{section}.{name}." not in (*OPTION_GROUPS, RESOURCES)
}
"""Dotted key -> its field in the model. Options are not included, since tasks and searches declare them."""
GROUPS = (*SECTIONS, *(group.removesuffix(".") for group in (*OPTION_GROUPS, RESOURCES)))
"""Names of sections and of groups inside sections, which hold keys and have no value."""
ALIASES = {
    "population": "search.pairs",
    "popsize": "search.pairs",
    "lr": "search.learning_rate",
    "std": "search.sigma",
}
"""Name that other libraries use -> our key."""
RENAMED = {"search.members": "search.centres", "search.member_choice": "search.centre_choice"}
"""Name of a key before version 0.6 -> its present name."""
BUDGET = [name for name in FIELDS if name.startswith("budget.")]
"""Keys of which at least one must be set."""


def sort_keys(mapping: Mapping[Any, Any], group: str = "") -> tuple[dict[str, Any], set[str], list[Problem]]:
    """Sort the keys of a nested mapping: (values by dotted key, names of groups that are not mappings, problems).

    There is a problem for each unknown key, each key with a dot, and each group that is not a mapping.
    """
    values: dict[str, Any] = {}
    unusable: set[str] = set()
    problems: list[Problem] = []
    for key, value in mapping.items():
        name = f"{group}{key}"
        if "." in str(key):
            section, leaf = name.rsplit(".", 1)
            problems.append(unfit(name, value, f"a key in a file has no dots; write {leaf} inside {section}:"))
        elif name in GROUPS and isinstance(value, Mapping):
            below = sort_keys(value, f"{name}.")
            values |= below[0]
            unusable |= below[1]
            problems += below[2]
        elif name in GROUPS:
            unusable.add(name)
            hint = f"indent its keys below `{_leaf(name)}:`, or delete the line to use the defaults"
            problems.append(unfit(name, value, f"{show(value)} is not a mapping of keys; {hint}"))
        elif name in FIELDS or group in OPTION_GROUPS:
            values[name] = value
        else:
            problems.append(_unknown_key(name, (*GROUPS, *FIELDS) if isinstance(value, Mapping) else FIELDS, value))
    return values, unusable, problems


MOST_NAMED = 16
"""Most keys that a message lists."""

Overrides = Iterable[str] | Mapping[str, Any]
"""Changes of a config: strings such as "search.sigma=0.05", with values in YAML, the last one for a key winning; or a
mapping from key to value."""


def parse_overrides(overrides: Overrides) -> tuple[dict[str, Any], list[Problem]]:
    """Values by dotted key, and a problem for each override that cannot be used."""
    values: dict[str, Any] = {}
    problems: list[Problem] = []
    if isinstance(overrides, Mapping):
        overrides = [f"{name}={in_line(value)}" for name, value in overrides.items()]
    for override in [overrides] if isinstance(overrides, str) else overrides:
        name, equals, text = (part.strip() for part in override.partition("="))
        where = f"override {override}"
        if not equals or not name or not text:
            example = "write KEY=VALUE, such as search.sigma=0.05"
            hint = "the value is missing; write null for no value" if name and equals else example
            problems.append(Problem(f"{where}: {hint}"))
        elif name in GROUPS:
            keys = [key for key in FIELDS if key.startswith(f"{name}.")] or [f"{name}.NAME"]
            what = f"{where}: {name} is a section; set its keys one by one, such as {keys[0]}=..."
            problems.append(Problem(what, name, text, suggestion=keys[0]))
        elif name in FIELDS or _is_option(name):
            try:
                values[name] = parse_value(text)
            except ValueError as error:
                problems.append(Problem(f"{where}: {error}", name, text))
        else:
            problem = _unknown_key(name, FIELDS, text)
            problems.append(replace(problem, sentence=f"{where}: {problem.sentence}"))
    return values, problems


def _is_option(name: str) -> bool:
    """Whether a key has the form of an option, of any task or search."""
    group, dot, option = name.rpartition(".")
    return option != "" and f"{group}{dot}" in OPTION_GROUPS


def _unknown_key(name: str, candidates: Iterable[str], value: Any) -> Problem:
    """The problem of an unknown key. It suggests the same name in another section, else the most similar key; if there
    is neither, it lists the keys of the section.

    Args:
        candidates: keys that may have been meant.
    """
    if name in RENAMED:
        return unfit(name, value, f"this key is now {RENAMED[name]}", suggestion=RENAMED[name])
    section, _, leaf = name.rpartition(".")
    everywhere = {_leaf(key): key for key in candidates}
    near_by = {leaf: key for leaf, key in everywhere.items() if key.rpartition(".")[0] == section}
    exactly = everywhere | ALIASES
    for keys in ({leaf: exactly[leaf]} if leaf in exactly else {}, near_by, everywhere):
        if near := nearest(leaf, keys):
            return unfit(name, value, f"unknown key; did you mean {keys[near]}?", suggestion=keys[near])
    if siblings := [_leaf(key) for key in (*GROUPS, *FIELDS) if key.rpartition(".")[0] == section]:
        named, others = siblings[:MOST_NAMED], len(siblings) - MOST_NAMED
        more = f" and {others} others" if others > 0 else ""
        return unfit(name, value, f"unknown key; {section or 'the top level'} has {', '.join(named)}{more}")
    return unfit(name, value, f"unknown key; the sections are {', '.join(SECTIONS)}")


def _leaf(name: str) -> str:
    return name.rpartition(".")[2]
