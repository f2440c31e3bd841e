"""The keys of a config: which there are with a method, and what is said of one that there is not.

This layer knows no method by name. Who loads a config passes the registry of methods, `algorithms`, by name; each has
its class of settings as the attribute `settings`. Iteration yields the shipped methods.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any, Literal, Protocol, get_args

from pydantic import BaseModel, Field
from pydantic.fields import FieldInfo

from es_service.config.model import RunConfig
from es_service.config.parts import RESOURCES, TASK_OPTIONS, Section
from es_service.config.search import SearchConfig
from es_service.config.sections import WorkerResources
from es_service.config.text import nearest, one_of, problem_of, show
from es_service.errors import Problem

KIND = "kind"
"""Key of a part that says which one it is."""
SECTIONS = {
    name: field.annotation
    for name, field in RunConfig.model_fields.items()
    if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)
}
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
BUDGET = [name for name in FIELDS if name.startswith("budget.")]
"""Keys of which at least one must be set."""
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
MOST_NAMED = 16
"""Most keys that a message lists."""


class HasSettings(Protocol):
    """A method, as far as a config is concerned."""

    @property
    def settings(self) -> type[SearchConfig]: ...


Methods = Mapping[str, HasSettings]


@cache
def parts_of(settings: type[SearchConfig]) -> dict[str, dict[str, type[Section]]]:
    """Key of each part, such as search.step -> kind -> the class with its keys."""
    return {
        f"search.{name}": {section.model_fields[KIND].default: section for section in get_args(field.annotation)}
        for name, field in settings.model_fields.items()
        if field.discriminator == KIND
    }


@cache
def search_fields(settings: type[SearchConfig]) -> dict[str, FieldInfo]:
    """Dotted key -> field of each key that a method has, for parts those of every kind, and for a group those in it."""
    fields: dict[str, FieldInfo] = {}
    for name, field in settings.model_fields.items():
        key = f"search.{name}"
        if isinstance(group := field.annotation, type) and issubclass(group, Section):
            fields |= {f"{key}.{leaf}": its for leaf, its in group.model_fields.items()}
            continue
        kinds = parts_of(settings).get(key)
        if kinds is None:
            fields[key] = field
            continue
        fields[f"{key}.{KIND}"] = kind = Field(field.default.kind, description=field.description)
        kind.annotation = Literal[tuple(kinds)]
        for section in kinds.values():
            for leaf, its in section.model_fields.items():
                fields.setdefault(f"{key}.{leaf}", its)
    return fields


def all_search_fields(algorithms: Methods) -> dict[str, FieldInfo]:
    """The fields of every shipped method, by key; of several with the same key, that of the first method."""
    fields: dict[str, FieldInfo] = {}
    for method in algorithms.values():
        fields = search_fields(method.settings) | fields
    return fields


def has_effect(key: str, settings: type[SearchConfig]) -> bool:
    """Whether a key of a config has an effect with a method."""
    return key in search_fields(settings) if key.startswith("search.") else key not in settings.unused


def methods_with(key: str, algorithms: Methods) -> tuple[str, ...]:
    """The shipped methods with which a key has an effect."""
    return tuple(name for name, method in algorithms.items() if has_effect(key, method.settings))


def kind_of(key: str) -> str:
    """The key that says of which kind the part is that has a key."""
    return f"{key.rpartition('.')[0]}.{KIND}"


def kinds_with(key: str, settings: type[SearchConfig]) -> tuple[str, ...]:
    """The kinds of its part that have a key; none if it is no key of a part."""
    part, _, leaf = key.rpartition(".")
    return tuple(name for name, kind in parts_of(settings).get(part, {}).items() if leaf in kind.model_fields)


def lacks(key: str, kind: object, settings: type[SearchConfig]) -> bool:
    """Whether a kind of a part does not have a key that other kinds of the part have."""
    known, kinds = parts_of(settings).get(key.rpartition(".")[0], {}), kinds_with(key, settings)
    return isinstance(kind, str) and kind in known and bool(kinds) and kind not in kinds


def no_effect(key: str, value: Any, method: str, algorithms: Methods, default: Any = None) -> Problem:
    """The problem of a key that has no effect with a method.

    Args:
        default: the value that the key has if it is left out, for one that every config has.
    """
    others = methods_with(key, algorithms)
    whose = f" (a key of {one_of(others, 'and')})" if others else ""
    what = f"{show(value)} has no effect with {method}; leave it out{whose}"
    return problem_of(key, value, what, suggestion=default)


def not_a_mapping(group: str, value: object) -> Problem:
    hint = f"indent its keys below `{_leaf(group)}:`, or delete the line to use the defaults"
    return problem_of(group, value, f"{show(value)} is not a mapping of keys; {hint}")


def key_problems(
    given: Mapping[str, Any],
    wanted: Mapping[str, Any],
    values: Mapping[str, Any],
    settings: type[SearchConfig] | None,
    algorithms: Methods,
) -> dict[str, Problem]:
    """Key -> problem of each key that a config with this method, and these kinds of its parts, cannot have.

    Args:
        given: all values that the config gives, by dotted key.
        wanted: those of them that overrides have set.
        values: all values, with the kind of each part.
        settings: those of the method; None if it is not known, which allows the keys of every method.
    """
    known = FIELDS | (search_fields(settings) if settings else all_search_fields(algorithms))
    parts = {part for method in algorithms.values() for part in parts_of(method.settings)}
    parts |= {key.rpartition(".")[0] for key in known if key.startswith("search.") and key.count(".") == 2}

    is_foreign = settings is None and ":" in str(given.get("search.algorithm"))

    def problem(key: str, value: Any) -> Problem | None:
        if is_foreign and key.startswith("search."):
            return None  # its keys are not known, since it could not be found
        if key in known:
            if not settings or not lacks(key, kind := values.get(kind_of(key)), settings):
                return None
            what = f"{show(value)} has no effect with {kind_of(key)} = {kind}; leave it out"
            return problem_of(key, value, f"{what} (a key of kind {one_of(kinds_with(key, settings))})")
        if key.startswith(TASK_OPTIONS) and _leaf(key) and key.count(".") == 2:
            return None
        if settings and key.startswith(SEARCH_OPTIONS) and "options" in settings.model_fields:
            return unknown_option(key, value, str(given["search.algorithm"]), settings)
        if key in RENAMED or key.startswith(SEARCH_OPTIONS):
            now = RENAMED.get(key, key.replace(SEARCH_OPTIONS, "search."))
            return problem_of(key, value, f"this key is now {now}", suggestion=now)
        if key in (*GROUPS, *parts):
            if key not in wanted:
                return not_a_mapping(key, value)
            first = next((name for name in known if name.startswith(f"{key}.")), f"{key}.NAME")
            return problem_of(
                key, value, f"this is a section; set its keys one by one, such as {first}=...", suggestion=first
            )
        if key.startswith("search.") and methods_with(key, algorithms):
            return no_effect(key, value, given["search.algorithm"], algorithms)
        groups = GROUPS if isinstance(value, Mapping) else ()
        unknown = unknown_key(key, (*groups, *known), value)
        if unknown.suggestion is None:
            unknown = unknown_key(key, (*groups, *known, *all_search_fields(algorithms)), value)
        return unknown

    return {key: found for key, value in given.items() if (found := problem(key, value))}


def unknown_option(key: str, value: Any, method: str, settings: type[SearchConfig]) -> Problem:
    """The problem of a key in `search.options` that a method with options does not have."""
    options = [_leaf(known) for known in search_fields(settings) if known.startswith(SEARCH_OPTIONS)]
    meant = nearest(_leaf(key), options)
    hint = f"; did you mean {meant}?" if meant else ""
    what = f"unknown option; {method} has {one_of(options, 'and') if options else 'none'}{hint}"
    return problem_of(key, value, what, suggestion=meant and f"{SEARCH_OPTIONS}{meant}")


def unknown_key(name: str, candidates: Iterable[str], value: Any) -> Problem:
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
