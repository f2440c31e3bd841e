"""What a config is made of: sections that take no wrong type, and types with what an error message says is allowed."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from es_service.protocol.messages import Bounds

OPTIONS = "task.options."
RESOURCES = "compute.worker_resources."
"""How the keys of the two groups inside a section begin."""


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _tuples(value: Any) -> Any:
    """Lists as tuples, and whole numbers among them as they are in a file: [[-1, 1], [0, 2.5]]."""
    if not isinstance(value, list | tuple):
        return value
    return tuple(
        tuple(float(x) if type(x) is int and abs(x) < 2**1000 else x for x in pair)
        if isinstance(pair, list | tuple)
        else pair
        for pair in value
    )


Count = Annotated[int, Field(ge=1), "a whole number, at least 1"]
Positive = Annotated[float, Field(gt=0), "a number above 0"]
NotNegative = Annotated[float, Field(ge=0), "a number, at least 0"]
Number = Annotated[float, "a number"]
Fraction = Annotated[float, Field(ge=0, le=1), "a number from 0 to 1"]
Seed = Annotated[int, Field(ge=0, lt=2**63), "a whole number, at least 0 and below 2**63"]
Switch = Annotated[bool, "true or false"]
Text = Annotated[str, Field(min_length=1), "text"]
Widths = Annotated[
    tuple[Count, ...],
    BeforeValidator(_tuple),
    "a list of whole numbers, each at least 1, such as [64, 64]",
]
BoundPairs = Annotated[Bounds, BeforeValidator(_tuples), "a list of pairs [low, high], such as [[-1, 1], [-1, 1]]"]
CellCounts = Annotated[
    tuple[Count, ...],
    Field(min_length=1),
    BeforeValidator(_tuple),
    "a list of whole numbers, each at least 1, such as [20, 20]",
]


class Section(BaseModel):
    """Frozen; a whole number is a number, but a number is no text."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)
