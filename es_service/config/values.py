"""What is wrong with a value by itself, and in words what is allowed; the keys of configs, described for people."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from types import FunctionType, NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from es_service.config.keys import (
    FIELDS,
    SECTIONS,
    Methods,
    all_search_fields,
    methods_with,
    search_fields,
)
from es_service.config.model import nested
from es_service.config.parts import TASK_OPTIONS, Section
from es_service.config.resolution import LEFT_OPEN, Unknown, Values
from es_service.config.search import SearchConfig, preset_rows
from es_service.config.text import not_allowed, one_of, problem_of, show, wrong_value
from es_service.errors import Problem
from es_service.protocol.user_code import in_no_file


def value_problems(
    values: Mapping[str, Any], settings: type[SearchConfig] | None, algorithms: Methods
) -> dict[str, Problem]:
    """Key -> problem for each value that is invalid by itself. Keys that nobody has are not reported here, nor options.

    Args:
        settings: those of the method; None if it is not known: then a value is invalid if no method allows it.
    """
    methods = [method.settings for method in algorithms.values()] if settings is None else [settings]
    problems: dict[str, Problem] = {}
    for key, value in values.items():
        having = [None] if key in FIELDS else [method for method in methods if key in search_fields(method)]
        if having and not any(_is_allowed(key, value, method) for method in having):
            problems[key] = _bad_value(key, value, _field(key, having[0]))
    return problems


def _field(key: str, settings: type[SearchConfig] | None) -> FieldInfo:
    """The field of a key: of a method with these settings, or of every config."""
    return FIELDS[key] if settings is None else search_fields(settings)[key]


@cache
def _type(key: str, settings: type[SearchConfig] | None) -> TypeAdapter:
    """The type of a key's values, as a section validates them."""
    field = _field(key, settings)
    annotated: Any = Annotated[field.annotation, "", *field.metadata]
    return TypeAdapter(annotated, config=Section.model_config)


def _is_allowed(key: str, value: Any, settings: type[SearchConfig] | None) -> bool:
    try:
        _type(key, settings).validate_python(value)
    except ValidationError:
        return False
    return True


def validator_problems(values: Values) -> list[Problem]:
    """The problems that validators find which the class of a search has, such as one of a user with two keys that must
    fit each other."""
    known = {key: value for key, value in values.known().items() if key.startswith("search.")}
    try:
        values.settings.model_validate(nested(known, ["search"])["search"])
    except Unknown:
        return []
    except ValidationError as error:  # what else is wrong is reported elsewhere
        raised = [item for item in error.errors() if item["type"] in ("value_error", "assertion_error")]
        keys = [".".join(("search", *map(str, item["loc"][:1]))) for item in raised]
        return [
            problem_of(key, known.get(key), str(item.get("ctx", {})["error"]))
            for key, item in zip(keys, raised, strict=True)
        ]
    return []


def _bad_value(name: str, value: object, field: FieldInfo) -> Problem:
    """The problem of an invalid value: what is allowed, and how to write what was probably meant."""
    allowed = allowed_words(field.annotation, field.metadata)
    if name in LEFT_OPEN:
        allowed = f"{show(LEFT_OPEN[name])} or {allowed}"
    choices = get_args(field.annotation) if get_origin(field.annotation) is Literal else ()
    if isinstance(value, type | FunctionType):
        path = f"{value.__module__}:{value.__qualname__}"
        return not_allowed(name, value, allowed, hint=f"; {in_no_file(path) or f'name it as text: {path}'}")
    return wrong_value(name, value, allowed, choices)


_PLAIN = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}
_LIMITS = (("ge", "at least"), ("gt", "above"), ("le", "at most"), ("lt", "below"))
"""Types and limits that the settings of a user's search may have without the words of `config/parts.py`."""


def allowed_words(annotation: Any, metadata: Iterable[object] = ()) -> str:
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
        return allowed_words(parts[0], parts[1:])
    if origin in (Union, UnionType):
        return " or ".join(allowed_words(part) for part in parts)
    if annotation is NoneType:
        return "null"
    return one_of(parts)


class DescribedKey(NamedTuple):
    key: str
    default: str
    """In YAML, both presets with a slash between, or "required"; then those of methods that have another one."""
    allowed: str
    """What values are allowed, in words."""
    methods: tuple[str, ...]
    """The methods with which it has an effect."""
    meaning: str


def described_keys(algorithms: Methods) -> list[DescribedKey]:
    """All keys, in the order of the sections: those of every config, then those of methods."""
    described = []
    for key, field in (FIELDS | all_search_fields(algorithms)).items():
        methods = methods_with(key, algorithms)
        defaults: dict[str, list[str]] = {}
        for name in methods or algorithms:
            defaults.setdefault(_default_text(key, algorithms[name].settings), []).append(name)
        first = max(defaults, key=lambda text: len(defaults[text]))
        others = [f"{text} with {one_of(names, 'and')}" for text, names in defaults.items() if text != first]
        left_open = f"{LEFT_OPEN[key]} or " if LEFT_OPEN.get(key) else ""
        allowed = f"{left_open}{allowed_words(field.annotation, field.metadata)}"
        described.append(DescribedKey(key, "; ".join([first, *others]), allowed, methods, field.description or ""))
    meaning, allowed = SECTIONS["task"].model_fields["options"].description or "", "what the task declares"
    described.append(DescribedKey(f"{TASK_OPTIONS}NAME", "the task's", allowed, tuple(algorithms), meaning))
    sections = [*SECTIONS, *FIELDS]  # a key outside of sections is its own
    return sorted(described, key=lambda row: sections.index(row.key.split(".")[0]))


def methods_words(methods: tuple[str, ...], algorithms: Methods) -> str:
    """Which methods have a key, in words; empty for all of them, or for a key of none."""
    others = [name for name in algorithms if name not in methods]
    if not others or not methods:
        return ""
    return f"all but {one_of(others, 'and')}" if len(others) < len(methods) else one_of(methods, "and")


def _default_text(key: str, settings: type[SearchConfig]) -> str:
    field = (FIELDS | search_fields(settings))[key]
    if row := {row.key: row for row in preset_rows(settings)}.get(key):
        return " / ".join(dict.fromkeys((show(row.literature), show(row.uber))))
    if key in LEFT_OPEN:
        return show(LEFT_OPEN[key])
    return "required" if field.is_required() else show(field.get_default(call_default_factory=True))
