"""Problems of a config, as data and as a line for the user: field, value, what is allowed, what was meant."""

from __future__ import annotations

from collections.abc import Collection
from difflib import get_close_matches
from typing import Any

from es_service.config.yaml_text import parse_value, show
from es_service.errors import ConfigError, Problem
from es_service.protocol.sources import meant_environment


def nearest(name: object, candidates: Collection[str]) -> str | None:
    """The candidate most similar to a name, in capitals or not; None if none is similar."""
    small = {candidate.lower(): candidate for candidate in candidates}
    near = get_close_matches(str(name).lower(), small, n=1)
    return small[near[0]] if near else None


def meant_task(name: str, known: Collection[str]) -> str | None:
    """The task that a name may mean: a similar one that is known, or an environment of Gymnasium; else None."""
    return nearest(name, known) or meant_environment(name) or None


def did_you_mean_task(name: str, known: Collection[str]) -> str:
    """`did_you_mean` for the name of a task."""
    meant = meant_task(name, known)
    return f"; did you mean {meant}?" if meant else ""


def did_you_mean(name: object, candidates: Collection[str]) -> str:
    """A hint to append to a message: "; did you mean X?", or "" if no candidate is similar."""
    near = nearest(name, candidates)
    return f"; did you mean {near}?" if near else ""


def one_of(names: Collection[str], word: str = "or") -> str:
    """Join names for a sentence: "a", "a or b", "a, b or c"; or with another word."""
    *first, last = map(str, names)
    return f"{', '.join(first)} {word} {last}" if first else last


def not_allowed(
    field: str, value: Any, allowed: str, *, why: str = "", hint: str = "", suggestion: Any = None
) -> Problem:
    """The problem of an invalid value: "search.pairs: 0 is not allowed; must be a whole number, at least 1".

    Args:
        why: words after "is not allowed", with the space before them.
        hint: the end of the line, instead of "; did you mean `suggestion`?".
    """
    ending = hint or (f"; did you mean {suggestion if isinstance(suggestion, str) else show(suggestion)}?"
                      if suggestion is not None else "")  # fmt: skip
    return Problem(
        f"{field}: {show(value)} is not allowed{why}; must be {allowed}{ending}", field, value, allowed, suggestion
    )


def wrong_value(field: str, value: Any, allowed: str, choices: Collection[Any] = ()) -> Problem:
    """The problem of a value that is invalid by itself, with how to write what was probably meant.

    Args:
        choices: the allowed values, if they are few.
    """
    hint, meant = "", None
    if value is None:
        hint = "; leave the key out to use its default"
    elif isinstance(value, str) and "number" in allowed and _is_number(value):
        hint, meant = f"; remove the quotes around {value}", parse_value(value)
    elif isinstance(value, float) and "whole number" in allowed and value.is_integer() and 1 <= value < 2**53:
        hint, meant = f"; write {int(value)}", int(value)
    elif isinstance(value, bool | int | float) and allowed == "text":
        hint = "; write it in quotes"
    elif isinstance(value, str):
        meant = nearest(value, [choice for choice in choices if isinstance(choice, str)])
    return not_allowed(field, value, allowed, hint=hint, suggestion=meant)


def _is_number(text: str) -> bool:
    try:
        return type(parse_value(text)) in (int, float)
    except ValueError:
        return False


def problem_of(field: str, value: Any, what: str, *, suggestion: Any = None, allowed: str | None = None) -> Problem:
    """The problem of a value that does not fit another one; `what` is the whole text after "field: "."""
    return Problem(f"{field}: {what}", field, value, allowed, suggestion)


def unknown_name(kind: str, name: str, known: Collection[str], field: str) -> ConfigError:
    """The error for a name that is not among those of its kind: "the format cvs is unknown; must be ..."."""
    return ConfigError(
        f"the {kind} {name} is unknown; must be {one_of(known)}{did_you_mean(name, known)}",
        field=field,
        value=name,
        allowed=one_of(known),
        suggestion=nearest(name, known),
    )
