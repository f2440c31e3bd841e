"""What methods declare in their settings, for the loader: which keys exist, and with which method they have an effect.

This layer knows no method by name. Who loads a config passes the registry of methods, `algorithms`, by name; each has
its class of settings as the attribute `settings`. Iteration yields the shipped methods.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, Literal, Protocol, get_args

from pydantic import Field
from pydantic.fields import FieldInfo

from es_service.config.fields import Section
from es_service.config.presets import PRESETS, preset_values
from es_service.config.problems import not_allowed, one_of, problem_of
from es_service.config.search import SearchConfig
from es_service.config.yaml_text import show
from es_service.errors import Problem
from es_service.protocol.policy_spec import NOISY_OUTPUTS


class HasSettings(Protocol):
    """A method, as far as a config is concerned."""

    @property
    def settings(self) -> type[SearchConfig]:
        """Its class of settings."""
        ...


Methods = Mapping[str, HasSettings]
KIND = "kind"
"""Key of a part that says which one it is."""


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
    """Dotted key -> field of each key that a method has, for parts those of every kind."""
    fields: dict[str, FieldInfo] = {}
    for name, field in settings.model_fields.items():
        key = f"search.{name}"
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


def are_alike(old: object, new: object, algorithms: Methods) -> bool:
    """Whether two shipped methods are of one family, so that a fork may change from one to the other."""
    families = [method.settings.family for name, method in algorithms.items() if name in (old, new)]
    return old == new or (len(families) == 2 and families[0] == families[1] != "")


def has_effect(key: str, settings: type[SearchConfig]) -> bool:
    """Whether a key of a config has an effect with a method."""
    return key in search_fields(settings) if key.startswith("search.") else key not in settings.unused


def methods_with(key: str, algorithms: Methods) -> tuple[str, ...]:
    """The shipped methods with which a key has an effect."""
    return tuple(name for name, method in algorithms.items() if has_effect(key, method.settings))


def filled_in(values: Mapping[str, Any], settings: type[SearchConfig]) -> dict[str, Any]:
    """Kinds of a method's parts, and what the config's preset fills in; an unknown preset fills in nothing."""
    fields = search_fields(settings)
    filled = {f"{part}.{KIND}": fields[f"{part}.{KIND}"].default for part in parts_of(settings)}
    preset = values.get("search.preset", fields["search.preset"].default)
    if isinstance(preset, str) and preset in PRESETS:
        filled |= preset_values(preset, settings)
    normalised = "policy.observation_normalization"
    if values.get(normalised, filled.get(normalised)) is False:
        filled["policy.observation_clip"] = None  # the bound is in standard deviations, which are then unknown
    if values.get("policy.output", "tanh") not in NOISY_OUTPUTS:
        filled["policy.action_noise"] = 0.0
    return filled


def kinds_without(key: str, kind: object, settings: type[SearchConfig]) -> tuple[str, ...]:
    """The kinds that have a key of a part, if the chosen kind has not; else none."""
    part, _, leaf = key.rpartition(".")
    kinds = parts_of(settings).get(part, {})
    if not isinstance(kind, str) or kind not in kinds or leaf in kinds[kind].model_fields:
        return ()
    return tuple(name for name, section in kinds.items() if leaf in section.model_fields)


def no_effect(key: str, value: Any, method: str, algorithms: Methods, default: Any = None) -> Problem:
    """The problem of a key that has no effect with a method.

    Args:
        default: the value that the key has if it is left out, for one that every config has.
    """
    others = methods_with(key, algorithms)
    whose = f" (a key of {one_of(others, 'and')})" if others else ""
    what = f"{show(value)} has no effect with {method}; leave it out{whose}"
    return problem_of(key, value, what, suggestion=default)


def method_problems(values: Mapping[str, Any], settings: type[SearchConfig]) -> list[Problem]:
    """Problems of settings that the method does not support; each has the key as its field."""
    method, problems = values["search.algorithm"], []
    centres, only = values.get("search.centres"), only_centres(values, settings)
    if only is not None and centres not in (None, "auto", only):
        each = "" if isinstance(settings.only_centres, int) else f" for each of {settings.only_centres}"
        why = f" for {method}, which has one centre{each}"
        problems.append(not_allowed("search.centres", centres, f"{only} or auto", why=why))
    if not settings.gathers_statistics and values.get("policy.observation_normalization") is True:
        why = f" for {method}, which has no training episodes to gather statistics from"
        problems.append(not_allowed("policy.observation_normalization", True, "false", why=why))
    if settings.needs_map and values.get("map.enabled", True) is False:
        problems.append(not_allowed("map.enabled", False, "true", why=f" for {method}, {settings.needs_map}"))
    return problems


def start_problems(values: Mapping[str, Any], settings: type[SearchConfig]) -> list[Problem]:
    """The problem of a new run without `search.init_from` whose method needs it. A fork has its parent's state."""
    if not settings.needs_start or values.get("search.init_from"):
        return []
    why = f" for {values['search.algorithm']}, {settings.needs_start}"
    return [not_allowed("search.init_from", values.get("search.init_from"), "the folder of a run", why=why)]


def only_centres(values: Mapping[str, Any], settings: type[SearchConfig]) -> int | None:
    """The only number of centres that a method supports; None if it supports any, or if its key has no valid value."""
    only = settings.only_centres
    return values.get(only, search_fields(settings)[only].default) if isinstance(only, str) else only
