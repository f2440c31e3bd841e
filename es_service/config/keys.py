"""The keys of a config: which there are, what a file or an override says of each, what is wrong with any other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from pydantic import BaseModel

from es_service.config.compute import WorkerResources
from es_service.config.fields import OPTIONS, RESOURCES
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
    if f"{section}.{name}." not in (OPTIONS, RESOURCES)
}
"""Dotted key -> what it may be; the task's options, whose names are the task's, are not among them."""
GROUPS = (*SECTIONS, OPTIONS.removesuffix("."), RESOURCES.removesuffix("."))
"""What holds keys and is no value itself."""
ALIASES = {
    "population": "search.pairs",
    "popsize": "search.pairs",
    "lr": "search.learning_rate",
    "std": "search.sigma",
}
"""What others call a key of ours."""
RENAMED = {"search.members": "search.centres", "search.member_choice": "search.centre_choice"}
"""What keys of ours were called before version 0.6."""
BUDGET = [name for name in FIELDS if name.startswith("budget.")]
"""Keys of which one must be set."""


def sort_keys(mapping: Mapping[Any, Any], group: str = "") -> tuple[dict[str, Any], set[str], list[Problem]]:
    """Flat values of the known keys, the groups that are no mapping, and the problems of both other kinds of key."""
    values: dict[str, Any] = {}
    unusable: set[str] = set()
    problems: list[Problem] = []
    for key, value in mapping.items():
        name = f"{group}{key}"
        if "." in str(key):
            section, leaf = name.rsplit(".", 1)
            problems.append(unfit(name, value, f"no dots in a file; write {leaf} inside {section}:"))
        elif name in GROUPS and isinstance(value, Mapping):
            below = sort_keys(value, f"{name}.")
            values |= below[0]
            unusable |= below[1]
            problems += below[2]
        elif name in GROUPS:
            unusable.add(name)
            hint = f"indent them below `{_leaf(name)}:`, or delete the line for the defaults"
            problems.append(unfit(name, value, f"{show(value)} where keys belong; {hint}"))
        elif name in FIELDS or group == OPTIONS:
            values[name] = value
        else:
            problems.append(_unknown_key(name, (*GROUPS, *FIELDS) if isinstance(value, Mapping) else FIELDS, value))
    return values, unusable, problems


Overrides = Iterable[str] | Mapping[str, Any]
"""Changes of a config: "search.sigma=0.05" and the like, values in YAML, later ones winning; or values by key."""


def parse_overrides(overrides: Overrides) -> tuple[dict[str, Any], list[Problem]]:
    """Values by dotted key, and a problem for each override that has none to give."""
    values: dict[str, Any] = {}
    problems: list[Problem] = []
    if isinstance(overrides, Mapping):
        overrides = [f"{name}={in_line(value)}" for name, value in overrides.items()]
    for override in [overrides] if isinstance(overrides, str) else overrides:
        name, equals, text = (part.strip() for part in override.partition("="))
        where = f"override {override}"
        if not equals or not name or not text:
            hint = "write null for no value" if name and equals else "write a.b=c, such as search.sigma=0.05"
            problems.append(Problem(f"{where}: {hint}"))
        elif name in GROUPS:
            keys = [key for key in FIELDS if key.startswith(f"{name}.")] or [f"{OPTIONS}start"]
            what = f"{where}: {name} is a section; set its keys one by one, such as {keys[0]}=..."
            problems.append(Problem(what, name, text, suggestion=keys[0]))
        elif name in FIELDS or _is_option(name):
            try:
                value = parse_value(text)
            except ValueError as error:
                problems.append(Problem(f"{where}: {error}", name, text))
                continue
            is_word = _is_option(name) and isinstance(value, bool | int | float)  # such as off, or 10
            values[name] = text if is_word else value
        else:
            problem = _unknown_key(name, FIELDS, text)
            problems.append(replace(problem, sentence=f"{where}: {problem.sentence}"))
    return values, problems


def _is_option(name: str) -> bool:
    """Whether a key is that of a task's option, whatever the task."""
    option = name.removeprefix(OPTIONS)
    return option not in ("", name) and "." not in option


def _unknown_key(name: str, candidates: Iterable[str], value: Any) -> Problem:
    """The problem of a key that is none: the same key elsewhere, else the nearest one, else what there is.

    Args:
        candidates: what may have been meant.
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
        return unfit(name, value, f"unknown key; {section or 'the top level'} has {', '.join(siblings)}")
    return unfit(name, value, f"unknown key; the sections are {', '.join(SECTIONS)}")


def _leaf(name: str) -> str:
    return name.rpartition(".")[2]
