"""Parts of a search that every method with a gradient can take, each chosen by its `kind`: the step and the shaping.

A kind is a class here, whose other fields are its keys, and a function in `search/steps/` or `search/shaping.py`.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from es_service.config.fields import Count, Fraction, NotNegative, Positive, Section


class AdamStep(Section):
    """Adam, as in the released code of the evolution-strategies papers."""

    kind: Literal["adam"] = "adam"
    learning_rate: Positive = Field(
        0.01,
        description="Length of a step. adam, adamw: about how far each parameter moves in a generation, in parameter "
        "units. plain: factor of the gradient estimate. clipup: length that a step adds to the velocity.",
    )
    l2: NotNegative = Field(
        0.005,
        description="Weight decay, added to the gradient before the step: lambda in -g + lambda x. adamw: the share of "
        "a centre, times learning_rate, that each step takes away.",
    )


class PlainStep(Section):
    """The gradient estimate times a factor."""

    kind: Literal["plain"] = "plain"
    learning_rate: Positive = Field(0.01, description="Factor of the gradient estimate.")
    l2: NotNegative = Field(0.005, description="Weight decay, as for adam.")


class AdamWStep(Section):
    """Adam whose weight decay stays outside of its moments."""

    kind: Literal["adamw"] = "adamw"
    learning_rate: Positive = Field(0.01, description="As for adam.")
    l2: NotNegative = Field(0.005, description="Share of a centre, times learning_rate, that each step takes away.")


class ClipUpStep(Section):
    """A momentum along normalised gradient estimates, with a greatest speed."""

    kind: Literal["clipup"] = "clipup"
    learning_rate: Positive = Field(0.01, description="Length that a step adds to the velocity.")
    l2: NotNegative = Field(0.005, description="Weight decay, as for adam.")
    max_speed: Positive | None = Field(
        None,
        description="Of kind clipup: greatest length of a step, in parameter units; null: learning_rate / 0.75.",
    )
    momentum: Fraction = Field(0.9, description="Of kind clipup: share of the velocity that a step keeps.")


class Ranks(Section):
    """Utilities evenly spaced by rank."""

    kind: Literal["ranks"] = "ranks"


class Signs(Section):
    """Of each pair, only which member is better."""

    kind: Literal["signs"] = "signs"


class Returns(Section):
    """The values, less their mean, over their standard deviation."""

    kind: Literal["returns"] = "returns"


class TopPairs(Section):
    """The differences within the best pairs, over the standard deviation of the values of these pairs."""

    kind: Literal["top_pairs"] = "top_pairs"
    count: Count | None = Field(
        None,
        description="Of kind top_pairs: number of pairs from which a step is computed, those with the highest value of "
        "their better member; null: all pairs.",
    )


Step = AdamStep | AdamWStep | PlainStep | ClipUpStep
Shaping = Ranks | Signs | Returns | TopPairs
