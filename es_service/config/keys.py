"""The keys of a config: which there are, what a file or `--set` says of each, and the message for one that is none."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from typing import Any

from pydantic import BaseModel

from es_service.config.compute import WorkerResources
from es_service.config.fields import OPTIONS, RESOURCES
from es_service.config.model import RunConfig
from es_service.config.yaml_text import parse_value, show

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
BUDGET = [name for name in FIELDS if name.startswith("budget.")]
"""Keys of which one must be set."""


def sort_keys(mapping: Mapping[Any, Any], group: str = "") -> tuple[dict[str, Any], set[str], list[str]]:
    """Flat values of the known keys, the groups that are no mapping, and the problems of both other kinds of key."""
    values: dict[str, Any] = {}
    unusable: set[str] = set()
    problems: list[str] = []
    for key, value in mapping.items():
        name = f"{group}{key}"
        if "." in str(key):
            section, leaf = name.rsplit(".", 1)
            problems.append(f"{name}: no dots in a file (they are for --set); write {leaf} inside {section}:")
        elif name in GROUPS and isinstance(value, Mapping):
            below = sort_keys(value, f"{name}.")
            values |= below[0]
            unusable |= below[1]
            problems += below[2]
        elif name in GROUPS:
            unusable.add(name)
            problems.append(
                f"{name}: {show(value)} where keys belong; indent them below `{_leaf(name)}:`, "
                "or delete the line for the defaults"
            )
        elif name in FIELDS or group == OPTIONS:
            values[name] = value
        else:
            problems.append(_unknown_key(name, (*GROUPS, *FIELDS) if isinstance(value, Mapping) else FIELDS))
    return values, unusable, problems


def parse_overrides(overrides: Iterable[str]) -> tuple[dict[str, Any], list[str]]:
    """Values by dotted key, and a problem for each override that has none to give."""
    values: dict[str, Any] = {}
    problems: list[str] = []
    for override in [overrides] if isinstance(overrides, str) else overrides:
        name, equals, text = (part.strip() for part in override.partition("="))
        where = f"override {override}"
        if not equals or not name or not text:
            hint = "write null for no value" if name and equals else "write a.b=c, such as search.sigma=0.05"
            problems.append(f"{where}: {hint}")
        elif name in GROUPS:
            keys = [key for key in FIELDS if key.startswith(f"{name}.")] or [f"{OPTIONS}start"]
            problems.append(f"{where}: {name} is a section; set its keys one by one, such as {keys[0]}=...")
        elif name in FIELDS or _is_option(name):
            try:
                value = parse_value(text)
            except ValueError as error:
                problems.append(f"{where}: {error}")
                continue
            is_word = _is_option(name) and isinstance(value, bool | int | float)  # such as off, or 10
            values[name] = text if is_word else value
        else:
            problems.append(f"{where}: {_unknown_key(name, FIELDS)}")
    return values, problems


def _is_option(name: str) -> bool:
    """Whether a key is that of a task's option, whatever the task."""
    option = name.removeprefix(OPTIONS)
    return option not in ("", name) and "." not in option


def _unknown_key(name: str, candidates: Iterable[str]) -> str:
    """The message for a key that is none: the same key elsewhere, else the nearest one, else what there is.

    Args:
        candidates: what may have been meant.
    """
    section, _, leaf = name.rpartition(".")
    everywhere = {_leaf(key): key for key in candidates}
    near_by = {leaf: key for leaf, key in everywhere.items() if key.rpartition(".")[0] == section}
    exactly = everywhere | ALIASES
    for keys in ({leaf: exactly[leaf]} if leaf in exactly else {}, near_by, everywhere):
        if near := get_close_matches(leaf, keys, n=1):
            return f"{name}: unknown key; did you mean {keys[near[0]]}?"
    if siblings := [_leaf(key) for key in (*GROUPS, *FIELDS) if key.rpartition(".")[0] == section]:
        return f"{name}: unknown key; {section or 'the top level'} has {', '.join(siblings)}"
    return f"{name}: unknown key; the sections are {', '.join(SECTIONS)}"


def _leaf(name: str) -> str:
    return name.rpartition(".")[2]
