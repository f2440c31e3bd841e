"""Building blocks of the config model: strict sections, and types annotated with the values allowed, in words."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from es_service.protocol.low_rank import MOST_RANK
from es_service.protocol.messages import Bounds
from es_service.protocol.options import OptionValue

TASK_OPTIONS = "task.options."
RESOURCES = "compute.worker_resources."
"""Prefixes of the keys in two groups inside sections; a task declares those of the first."""


def as_tuple(value: Any) -> Any:
    """A list as a tuple, since a file has lists and a config has none."""
    return tuple(value) if isinstance(value, list) else value


def counts(value: Any) -> Any:
    """A list as a tuple, and a single whole number as a tuple of one."""
    return (value,) if type(value) is int else as_tuple(value)


def _tuples(value: Any) -> Any:
    """Convert nested lists to tuples and whole numbers in them to floats, for values such as [[-1, 1], [0, 2.5]]."""
    if not isinstance(value, list | tuple):
        return value
    return tuple(
        tuple(float(x) if type(x) is int and abs(x) < 2**1000 else x for x in pair)
        if isinstance(pair, list | tuple)
        else pair
        for pair in value
    )


Count = Annotated[int, Field(ge=1), "a whole number, at least 1"]
CountAtOnce = Annotated[int, Field(ge=1, le=2**24), f"a whole number from 1 to {2**24:,}"]
"""Number of what a generation keeps in memory at the same time."""
Rank = Annotated[int, Field(ge=1, le=MOST_RANK), f"a whole number from 1 to {MOST_RANK}"]
Positive = Annotated[float, Field(gt=0), "a number above 0"]
Patience = Annotated[float, Field(ge=20), "a number, at least 20"]
NotNegative = Annotated[float, Field(ge=0), "a number, at least 0"]
Number = Annotated[float, "a number"]
Fraction = Annotated[float, Field(ge=0, le=1), "a number from 0 to 1"]
Share = Annotated[float, Field(gt=0, le=1), "a number above 0, at most 1"]
Seed = Annotated[int, Field(ge=0, lt=2**63), "a whole number, at least 0 and below 2**63"]
Switch = Annotated[bool, "true or false"]
Text = Annotated[str, Field(min_length=1), "text"]
Options = dict[Text, OptionValue]
"""Values of options by name; `config/options.py` checks them against what is declared."""
Widths = Annotated[
    tuple[Count, ...],
    BeforeValidator(as_tuple),
    "a list of whole numbers, each at least 1, such as [64, 64]",
]
Point = Annotated[tuple[float, ...], BeforeValidator(as_tuple), "a list of numbers, such as [35, -25]"]
BoundPairs = Annotated[Bounds, BeforeValidator(_tuples), "a list of pairs [low, high], such as [[-1, 1], [-1, 1]]"]
CellCounts = Annotated[
    tuple[Count, ...],
    Field(min_length=1),
    BeforeValidator(counts),
    "a list of whole numbers, each at least 1, such as [20, 20], or one such number",
]


Descriptor = Annotated[
    Text | tuple[Annotated[int, Field(ge=0)], ...],
    BeforeValidator(as_tuple),
    "a list of whole numbers, such as [0, 1], or the name of a key of info, or module:function",
]


class Section(BaseModel):
    """Base of the config sections: frozen, no unknown keys, no conversion of types except from int to float."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)
