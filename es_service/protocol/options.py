"""Settings that a task declares: options with a default and what is allowed, and parameters of a function.

    options = {
        "start": ("default", "corner"),    # one of these values, the first of which is the default
        "reach": Option(0.5, low=0.0),     # a number of the type of the default, here within a bound
    }

They are the attribute `options` of the task's class. A config sets them below `task.options`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.noise import Domain, stream_keys, uniforms

OptionValue = bool | int | float | str | list[Any] | dict[str, Any]
"""Lists and mappings, of plain values and of their like, are values of options that Gymnasium's environments have."""


@dataclass(frozen=True)
class Option:
    """A setting whose values have the type of its default: bool, int, float or str."""

    default: OptionValue | None
    """None: no value unless one is given, which may be any plain one. Only our own tasks have such options: those of
    Gymnasium, whose environments then have what they have by themselves, descriptors of suites, and the start of a
    caller's episodes."""
    low: int | float | None = None
    high: int | float | None = None
    """Least and greatest value of a number, both allowed; None for no bound."""
    choices: tuple[OptionValue, ...] = ()
    """The only allowed values; empty if there are others."""


def choice(*values: OptionValue) -> Option:
    """An option with a few allowed values, the first of which is the default."""
    return Option(values[0], choices=values)


def declared_options(owner: object) -> tuple[dict[str, Option], list[str]]:
    """The options that a class declares in its attribute `options`, and what is wrong with them."""
    given: Any = getattr(owner, "options", {})
    if not isinstance(given, Mapping):
        return {}, [f"options = {given!r} is not a mapping from names to options"]
    options: dict[str, Any] = {
        name: choice(*option) if isinstance(option, tuple) and option else option for name, option in given.items()
    }
    wrong = [f"option {name!r} {problem}" for name, option in options.items() if (problem := _problem(name, option))]
    return ({}, wrong) if wrong else (options, [])


def _problem(name: object, option: object) -> str:
    """What is wrong with a declared option; empty if nothing is."""
    if not isinstance(name, str) or not name.isidentifier():
        return "has a name that no argument can have"
    if not isinstance(option, Option):
        return f"= {option!r} is neither an Option nor a tuple of allowed values, the default first"
    values, kind = (option.default, *option.choices), type(option.default)
    bounds = [bound for bound in (option.low, option.high) if bound is not None]
    if kind not in (bool, int, float, str) or any(type(value) is not kind for value in values):
        return f"= {option!r} has values that are not all of one type among bool, int, float and str"
    if option.choices and (option.default not in option.choices or bounds):
        return f"= {option!r} has choices, so its default must be one of them, and it needs no bounds"
    if bounds and (kind not in (int, float) or not all(type(bound) in (int, float) for bound in bounds)):
        return f"= {option!r} has bounds that are not numbers, or a default that is none"
    if not all(is_within(option, value) for value in values):
        return f"= {option!r} has a number outside its bounds, or one that is not finite"
    return ""


def option_values(options: Mapping[str, Option], given: Mapping[str, object]) -> dict[str, OptionValue]:
    """Values of all options: what is given, as far as it is allowed, and else the defaults."""
    values = defaults_of(options)
    for name, option in options.items():
        if (allowed := allowed_value(option, given.get(name))) is not None:
            values[name] = allowed
    return values


def defaults_of(options: Mapping[str, Option]) -> dict[str, OptionValue]:
    return {name: option.default for name, option in options.items() if option.default is not None}


def is_plain(value: object) -> bool:
    """Whether a value is a bool, a finite number, text, or a list or mapping of such values and null."""
    if isinstance(value, list):
        return all(item is None or is_plain(item) for item in value)
    if isinstance(value, dict):
        return all(isinstance(key, str) and (item is None or is_plain(item)) for key, item in value.items())
    return isinstance(value, bool | int | str) or (isinstance(value, float) and math.isfinite(value))


def allowed_value(option: Option, value: object) -> OptionValue | None:
    """A given value as a value of an option, a whole number also where the option has other numbers; None if it is not
    allowed."""
    kind = type(option.default)
    if kind is float and type(value) is int and abs(value) < 2**1000:
        value = float(value)
    if not isinstance(value, bool | int | float | str | list | dict) or not is_plain(value):
        return None
    if option.default is None:
        return value
    return (
        value
        if type(value) is kind and (not option.choices or value in option.choices) and is_within(option, value)
        else None
    )


def allowed_text(option: Option, show: Callable[[OptionValue | float], str] = repr) -> str:
    """What an option allows, in words; `show` writes a value."""
    if option.choices:
        *first, last = map(show, option.choices)
        return f"{', '.join(first)} or {last}" if first else last
    if option.default is None:
        return "true or false, a finite number, text, or a list or mapping of these"
    if isinstance(option.default, bool | str | list | dict):
        return {bool: "true or false", str: "text", list: "a list", dict: "a mapping"}[type(option.default)]
    number = "a whole number" if isinstance(option.default, int) else "a number"
    low, high = option.low, option.high
    if low is not None and high is not None:
        return f"{number} from {show(low)} to {show(high)}"
    bounds = [f"at {word} {show(bound)}" for word, bound in (("least", low), ("most", high)) if bound is not None]
    return ", ".join([number, *bounds])


def is_within(option: Option, value: OptionValue | None) -> bool:
    """Whether a value is within the bounds of an option and, if it is a number, finite."""
    if not isinstance(value, bool | int | float):
        return True
    low, high = -math.inf if option.low is None else option.low, math.inf if option.high is None else option.high
    return low <= value <= high and abs(value) != math.inf


# Parameters of a function that is a task: their names, bounds and start, and the numbers that a search moves.
#
# Axis: D parameters.

FREE = (-1e300, 1e300)
"""Bounds of a parameter that has none."""


class ParameterSpec(NamedTuple):
    names: tuple[str, ...]
    bounds: tuple[tuple[float, float], ...]
    """(low, high), or FREE."""
    start: tuple[float, ...]
    """Where a search starts, in the units of the function."""

    def named(self, searched: Any) -> dict[str, float]:
        """Parameters of what a search moves, [D], by name."""
        return dict(zip(self.names, self.values(searched).tolist(), strict=True))

    def text(self, searched: Any, most: int | None = None) -> str:
        """Names and values of what a search moves, [D], such as `width = 0.3, height = 1.0`.

        Args:
            most: how many of them are shown; None for all.
        """
        named = [f"{name} = {value!r}" for name, value in self.named(searched).items()]
        left = 0 if most is None else len(named) - most
        return ", ".join(named[:most]) + (f" and {left} more" if left > 0 else "")

    def values(self, searched: Any) -> NDArray[np.float64]:
        """Parameters [..., D] of what a search moves: -1 and 1 stand for the bounds, at which is put what is beyond."""
        low_D, high_D, middle_D, half_D = self._scales()
        return np.clip(middle_D + half_D * np.asarray(searched, np.float64), low_D, high_D)

    def first(self, seed: int, centre: int) -> NDArray[np.float32]:
        """What a search moves, as a centre of it begins: the first one at the start, and the others anywhere between
        the bounds, or within 1 of the start where there are none."""
        low_D, _, middle_D, half_D = self._scales()
        start_D = (np.asarray(self.start) - middle_D) / half_D
        if centre == 0:
            return start_D.astype(np.float32)
        key = stream_keys(seed, Domain.INITIALISATION, 0, centre)
        drawn_D = 2.0 * uniforms(key, np.arange(len(self.names), dtype=np.uint32)).astype(np.float64) - 1.0
        return np.where(low_D == FREE[0], start_D + drawn_D, drawn_D).astype(np.float32)

    def _scales(self) -> tuple[NDArray[np.float64], ...]:
        """Lower and upper bounds, their middles, and half of the distances between them; 0 and 1 if there are none."""
        low_D, high_D = np.asarray(self.bounds, np.float64).reshape(-1, 2).T
        is_free_D = low_D == FREE[0]
        return (
            low_D,
            high_D,
            np.where(is_free_D, 0.0, 0.5 * low_D + 0.5 * high_D),
            np.where(is_free_D, 1.0, 0.5 * high_D - 0.5 * low_D),
        )
