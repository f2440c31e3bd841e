"""Building blocks of a config: types annotated with the values allowed, in words, and the parts of a search.

A part is chosen by its `kind`, which is a class here whose other fields are its keys: the step, the shaping, the noise,
the elites, and what members are ranked by (objectives). Each kind has a function in `search/steps.py`,
`search/shaping.py` or `search/maps/`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from es_service.protocol.episodes import CHOSEN_METRIC
from es_service.protocol.messages import Bounds
from es_service.protocol.options import OptionValue
from es_service.protocol.policy_spec import MOST_RANK

TASK_OPTIONS = "task.options."
RESOURCES = "compute.worker_resources."
"""Prefixes of the keys in two groups inside sections; a task declares those of the first."""
LARGEST = 1e30
"""Largest absolute value of bounds, offsets and starts, so that their sums and differences stay finite."""


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
"""Values of options by name; `config/tasks.py` checks them against what is declared."""
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

Metrics = Annotated[
    tuple[Annotated[str, Field(pattern=CHOSEN_METRIC)], ...],
    BeforeValidator(as_tuple),
    "a list of keys of info, such as [x_position, reward_ctrl:sum]",
]


class Section(BaseModel):
    """Base of the config sections: frozen, no unknown keys, no conversion of types except from int to float."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)


class AdamStep(Section):
    """Adam, as in the released code of the evolution-strategies papers."""

    kind: Literal["adam"] = "adam"
    learning_rate: Positive = Field(
        0.01,
        description="Length of a step. `adam`, `adamw`: about how far each parameter moves in a generation, in "
        "parameter units. `plain`: factor of the gradient estimate. `clipup`: length that a step adds to the "
        "velocity.",
    )
    l2: NotNegative = Field(
        0.005,
        description="Weight decay, added to the gradient before the step: lambda in -g + lambda x. `adamw`: the share "
        "of a centre, times `learning_rate`, that each step takes away.",
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
        description="Of kind `clipup`: greatest length of a step, in parameter units; `null`: `learning_rate` / 0.75.",
    )
    momentum: Fraction = Field(0.9, description="Of kind `clipup`: share of the velocity that a step keeps.")


class FullNoise(Section):
    """Each parameter has a normal number of its own."""

    kind: Literal["full"] = "full"

    rank: ClassVar[int] = 0
    """That of `WorkerSpec.noise_rank`."""


class LowRankNoise(Section):
    """Each weight matrix moves along a product of two thin matrices of normal numbers."""

    kind: Literal["low_rank"] = "low_rank"
    rank: Rank = Field(1, description="Of kind `low_rank`: columns of the thin matrices.")


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
        description="Of kind `top_pairs`: number of pairs from which a step is computed, those with the highest value "
        "of their better member; `null`: all pairs.",
    )


class ObjectivePart(Section):
    """What members are ranked by."""

    reads: ClassVar[tuple[str, ...]] = ()
    """Outputs of episodes that it reads beside those of every result: names of `protocol.episodes.AT_THE_END`."""


class FitnessObjective(ObjectivePart):
    """Fitness, which `task.fitness` defines."""

    kind: Literal["fitness"] = "fitness"


class ReturnObjective(ObjectivePart):
    """The sum of the rewards, whatever `task.fitness` is."""

    kind: Literal["return"] = "return"


class FinalObjective(ObjectivePart):
    """The reward of the last valid step, whatever `task.fitness` is, in a task that allows `task.fitness: final`."""

    kind: Literal["final"] = "final"
    reads = ("last_reward",)


class GoalObjective(ObjectivePart):
    """How near to the goal an episode ends, in a task that has one."""

    kind: Literal["goal_distance"] = "goal_distance"


class NoveltyObjective(ObjectivePart):
    """Novelty in the novelty archive."""

    kind: Literal["novelty"] = "novelty"


class MixtureObjective(ObjectivePart):
    """Fitness and novelty, each shaped by itself."""

    kind: Literal["mixture"] = "mixture"
    weight: Fraction = Field(
        0.5,
        description="Of kind `mixture`: weight of fitness beside novelty; of kind `nearness`: weight of nearness "
        "beside fitness.",
    )


class TargetObjective(ObjectivePart):
    """Fitness among the members that end in a ball of descriptors; all others rank below these, by their distance."""

    kind: Literal["target"] = "target"
    descriptor: Point = Field(
        (),
        description="Of kind `target`: middle of the set; of kind `nearness`: the descriptor to be near to; one "
        "number for each dimension.",
    )
    radius: Positive = Field(1.0, description="Of kind `target`: greatest distance from the middle inside of the set.")
    ties: Literal["share", "distance"] = Field(
        "share",
        description="Of kind `target`: how those rank that end inside with equal fitness. `share`: they share the mean "
        "of their ranks. `distance`: the nearer to the middle, the higher; for rewards that are 0 in most of the set.",
    )


class NearnessObjective(ObjectivePart):
    """Nearness to a descriptor and fitness, each scaled to the range that it has in the population."""

    kind: Literal["nearness"] = "nearness"
    descriptor: Point = Field((), description="Of kind nearness: the descriptor, one number for each dimension.")
    weight: Fraction = Field(0.5, description="Of kind nearness: weight of nearness beside fitness.")


Again = Annotated[float, Field(ge=0, lt=1), "a number from 0 to below 1"] | Literal["all"]


class Once(Section):
    """Elites are measured once, and keep what that said."""

    kind: Literal["once"] = "once"


class Measured(Section):
    """Elites that are measured again: a cell keeps several policies, each where all of its samples say.

    The defaults of a kind are those of the method that it is named after.
    """

    depth: Count = Field(
        8,
        description="Policies that a cell keeps; the fittest is its elite. Kind `once` has no such keys.",
    )
    again: Again = Field(
        0.25,
        description="Share of a generation's episodes that measure kept policies again; `all`: every kept policy once "
        "in each generation, besides the other episodes.",
    )
    draw: Literal["exponential", "linear", "harmonic", "uniform"] = Field(
        "exponential",
        description="How these policies are drawn, by their rank in their cell, 0 for the fittest. `exponential`: in "
        "proportion to exp(-rank). `linear`: to the deepest rank + 1 - rank. `harmonic`: to 1 / (rank + 1). "
        "`uniform`: all alike.",
    )
    estimate: Literal["mean", "median"] = Field(
        "mean",
        description="What of its samples says the fitness and the descriptor of a policy: their `mean`, or their "
        "`median`.",
    )


class MeasuredNewcomers(Measured):
    """The same for a search whose newcomers may be measured several times before they are compared."""

    first_samples: Count = Field(2, description="Samples of each new policy before it is compared.")
    replaces: Literal["worst", "any"] = Field(
        "worst",
        description="What a new policy replaces in a full cell. `worst`: the least fit, if that is less fit. `any`: a "
        "random one, whatever its fitness; parents are then drawn from all policies of a cell, in proportion to "
        "their fitness above the lowest.",
    )


class Extract(MeasuredNewcomers):
    """Extract-ME: Flageat et al. 2025 (arXiv:2502.06585)."""

    kind: Literal["eme"] = "eme"


class ArchiveSampling(MeasuredNewcomers):
    """Archive-Sampling: Flageat and Cully 2023 (arXiv:2302.00463)."""

    kind: Literal["archive_sampling"] = "archive_sampling"
    depth: Count = 2
    again: Again = "all"
    first_samples: Count = 1


class ExplicitSampling(MeasuredNewcomers):
    """MAP-Elites-Sampling, explicit averaging: Flageat and Cully 2023 (arXiv:2302.00463)."""

    kind: Literal["me_sampling"] = "me_sampling"
    depth: Count = 1
    again: Again = 0.0
    first_samples: Count = 32


class DeepGrid(MeasuredNewcomers):
    """Deep-Grid: Flageat and Cully 2020."""

    kind: Literal["deep_grid"] = "deep_grid"
    depth: Count = 32
    again: Again = 0.0
    first_samples: Count = 1
    replaces: Literal["worst", "any"] = "any"


class ExtractCentres(Measured):
    """The container of Extract-ME for centres, each of which is measured once, by its evaluation episodes."""

    kind: Literal["eme"] = "eme"


class ArchiveSamplingCentres(Measured):
    """That of Archive-Sampling, likewise."""

    kind: Literal["archive_sampling"] = "archive_sampling"
    depth: Count = 2
    again: Again = "all"


Elites = Once | Extract | ArchiveSampling | ExplicitSampling | DeepGrid
ElitesOfCentres = Once | ExtractCentres | ArchiveSamplingCentres
Step = AdamStep | AdamWStep | PlainStep | ClipUpStep
Noise = FullNoise | LowRankNoise
Shaping = Ranks | Signs | Returns | TopPairs
Objective = (
    FitnessObjective
    | ReturnObjective
    | FinalObjective
    | GoalObjective
    | NoveltyObjective
    | MixtureObjective
    | TargetObjective
    | NearnessObjective
)
Objectives = Annotated[
    tuple[Annotated[Objective, Field(discriminator="kind")], ...],
    Field(min_length=1),
    BeforeValidator(as_tuple),
    "a list of objectives, such as [{kind: novelty}, {kind: fitness}, {kind: mixture, weight: 0.5}, {kind: target, "
    "descriptor: [35, -25], radius: 5}], also of kind return, final, goal_distance or nearness",
]


def outputs_of(objectives: Iterable[Objective]) -> tuple[str, ...]:
    """Outputs of episodes that any of the objectives reads."""
    return tuple(sorted({name for objective in objectives for name in objective.reads}))
