"""The config section `search`: the keys of every method, and those of methods that perturb a centre.

The settings of a method are a class that derives from one of these two and stands in the method's own file. Its fields
are the method's keys; its class variables and its methods declare what the rest of the service has to know of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from es_service.config.parts import (
    AdamStep,
    Count,
    CountAtOnce,
    FitnessObjective,
    Fraction,
    FullNoise,
    Noise,
    NotNegative,
    Objective,
    Positive,
    Ranks,
    Section,
    Shaping,
    Share,
    Step,
    Switch,
    Text,
    outputs_of,
)

PRESETS = MappingProxyType(
    {
        "literature": "values of independent implementations; our own choice where they specify none",
        "uber": "values of the authors' released ME-ES code",
    }
)
"""Preset name -> its meaning. Each name is also a column of the table."""


@dataclass(frozen=True)
class PresetRow:
    """One config key on which the presets differ, or in which a method differs from the others."""

    key: str
    """Dotted name in the config, such as `search.pairs`."""
    literature: object
    uber: object
    source: str
    """Where both values come from, and what is our own choice."""
    method: str | None = None
    """The only `search.algorithm` that the row is for, though others have the key too; None: all that have the key."""


def same(key: str, value: object, source: str) -> PresetRow:
    """A row with one value for both presets, in which a method differs from the others."""
    return PresetRow(key, value, value, f"literature: {source}. uber: the same.")


def preset_rows(settings: type[Any]) -> list[PresetRow]:
    """Rows for a method with these settings: those of the classes above it first, its own last."""
    return [row for above in reversed(settings.__mro__) for row in vars(above).get("presets", ())]


def preset_table(algorithms: Mapping[str, Any]) -> list[PresetRow]:
    """Rows of all methods, for documentation: those for several methods first."""
    rows: dict[int, PresetRow] = {}
    for name, method in algorithms.items():
        settings = method.settings
        added_keys = {f"search.{key}" for key in settings.model_fields.keys() - settings.__base__.model_fields.keys()}
        added_rows = vars(settings).get("presets", ())
        rows |= {
            id(row): replace(row, method=name) if row in added_rows and row.key not in added_keys else row
            for row in preset_rows(settings)
        }
    return sorted(rows.values(), key=lambda row: row.method is not None)


class SearchConfig(Section):
    """The search. Constants of the run."""

    algorithm: Text = Field(
        description="Name of the method: a shipped one, `evosax:NAME` for an optimiser of evosax, or "
        "`module:function` for one of your own."
    )
    preset: Literal["literature", "uber"] = Field(
        "literature", description="Which column of the preset table fills in the keys that the config leaves out."
    )
    centres: CountAtOnce = Field(
        description="Number of centres searched side by side, each with its own optimiser. `auto`: as many as the "
        "method usually has, 1 for a search of your own."
    )
    evaluation_episodes: CountAtOnce = Field(
        30, description="Noise-free episodes on which each new centre is evaluated. They count as environment steps."
    )
    max_invalid_fraction: Fraction = Field(
        0.5,
        description="Share of invalid members, in whose episodes something is not finite, above which the run stops "
        "with an error. `status`, the end of a run and reports say the share of the last generation, if there were "
        "any.",
    )
    allow_infeasible: Switch = Field(
        False,
        description="Whether a fitness of -inf says that a point is infeasible, and not that something failed. Such "
        "a member ranks last and enters neither map nor novelty archive, but is not counted as invalid: the history "
        "has a column `infeasible_members`, and `search.max_invalid_fraction` leaves them out.",
    )
    init_from: Text | None = Field(
        None,
        description="Policy of another run from which this run starts: `RUN` (its folder) for the centre updated "
        "last, `RUN:best` for the best centre, or `RUN:3,17` for a cell's elite; `null` for random weights.",
    )

    if TYPE_CHECKING:  # for `config.search.sigma` in a user's program, whose config has such a method
        # The keys of PopulationConfig, whose types a language server then knows of `RunConfig.search`, too. Of a search
        # without them, an access raises AttributeError.
        pairs: int = 0
        sigma: float = 0.0
        noise: Noise = Field()
        sigma_decay: float = 0.0
        sigma_limit: float = 0.0
        step: Step = Field()
        learning_rate_decay: float = 0.0
        learning_rate_limit: float = 0.0
        step_gate: bool = False
        shaping: Shaping = Field()
        common_random_numbers: bool = False

    presets: ClassVar[tuple[PresetRow, ...]] = (
        # Column norms: 1.0 in hidden layers and 0.01 in the output layer, or 0.01 in every layer.
        PresetRow("policy.init", "unit_columns", "small_columns", "literature: ES-starter and DNE. uber: ME-ES."),
        PresetRow("policy.observation_clip", 5.0, None, "literature: ES-starter and DNE. uber: ME-ES, without a clip."),
        PresetRow("novelty.distance", "euclidean", "squared_euclidean", "literature: DNE and QDax. uber: ME-ES."),
    )
    """Values by preset of this class's own keys, and of keys that it has from elsewhere, which precede those of the
    classes above it."""
    first_centres: ClassVar[int] = 1
    """What `centres: auto` stands for."""
    only_centres: ClassVar[int | str | None] = None
    """The only number of centres that is allowed, or the key that has it; None: any number."""
    needs_start: ClassVar[str] = ""
    """What the method needs `init_from` for, as a clause about it; empty if it can start from random weights."""
    spread_by: ClassVar[tuple[str, ...]] = ()
    """Keys whose smaller values keep new policies nearer to those of which they are made."""
    needs_map: ClassVar[str] = ""
    """What the method needs a behaviour map for, as a clause about it: "whose ..."; empty if it needs none."""
    map_kinds: ClassVar[tuple[str, ...]] = ("grid", "cvt")
    """Kinds of maps that it can fill. For `dominated`, a generation offers all that it has evaluated at once."""
    gathers_statistics: ClassVar[bool] = False
    """Whether it has training episodes, from which observation statistics are gathered."""
    unused: ClassVar[tuple[str, ...]] = (
        "task.episodes_per_member",
        "policy.action_noise",
        "compute.chunk_pairs",
        "compute.rollout_block_pairs",
        "compute.gradient_block_pairs",
    )
    """Keys of other sections that have no effect with it."""
    family: ClassVar[str] = ""
    """Methods of one family have states of the same form: a fork may change from one to another. They differ only in
    the weight of fitness, which the fork starts anew. Empty: it has no such relatives."""

    def populations(self) -> int:
        """Number of populations that a generation asks for at most."""
        return 0

    def policies(self) -> int:
        """Number of policies that a generation asks for at most, where it asks for no populations."""
        return 1

    def spread_keys(self) -> tuple[str, ...]:
        """Keys that change the number of populations, or of policies."""
        return ()

    def outputs(self) -> tuple[str, ...]:
        """Outputs of episodes that it reads beside those of every result: names of `protocol.episodes.AT_THE_END`.

        They are then in the `outputs` of each `EpisodesResult`, of populations and of evaluations.
        """
        return ()


class PopulationConfig(SearchConfig):
    """A search that perturbs centres with pairs of noise and moves them along gradient estimates."""

    pairs: CountAtOnce = Field(
        description="Antithetic pairs of a population, which has twice as many members. A generation has one "
        "population, or one for each centre with `search.emitters` and `search.update: all`."
    )
    sigma: Positive = Field(0.02, description="Standard deviation of the parameter noise, in parameter units.")
    noise: Noise = Field(
        FullNoise(),
        discriminator="kind",
        description="What a member adds to the parameters of a centre, times `search.sigma`. `full`: a normal number "
        "for each parameter. `low_rank`: for each weight matrix a product of two thin matrices of normal numbers, "
        "which costs less the wider the layers are; biases have a normal number each.",
    )
    sigma_decay: Share = Field(
        1.0, description="Factor by which sigma changes in each generation; 1 keeps it. EvoJAX has 0.999."
    )
    sigma_limit: NotNegative = Field(0.0, description="Sigma never falls below this.")
    step: Step = Field(
        AdamStep(learning_rate=0.01, l2=0.005),
        discriminator="kind",
        description="How a centre moves along the gradient estimate. `adam`: by Adam. `adamw`: by Adam, with a "
        "weight decay outside of its moments. `plain`: by the estimate times the learning rate. `clipup`: by ClipUp, "
        "a momentum along normalised estimates with a greatest speed.",
    )
    learning_rate_decay: Share = Field(
        1.0, description="Factor by which the learning rate changes in each generation; 1 keeps it. EvoJAX has 0.999."
    )
    learning_rate_limit: NotNegative = Field(0.0, description="The learning rate never falls below this.")
    step_gate: Switch = Field(
        False,
        description="Whether each step is shortened to the agreement of the two halves of the pairs: the learning "
        "rate is multiplied by the cosine between their gradient estimates, or by 0 if that is negative. Pairs without "
        "weight are in neither half. With `clipup`, this shortens what is added to the velocity, and its greatest "
        "speed only if `max_speed` is null. Gradients then cost twice as much.",
    )
    shaping: Shaping = Field(
        Ranks(),
        discriminator="kind",
        description="How fitness, and novelty, become utilities of members. `ranks`: evenly spaced by rank. `signs`: "
        "of each pair, only which member is better. `returns`: the values, less their mean, over their standard "
        "deviation. `top_pairs`: the differences within the best pairs, over the standard deviation of the values of "
        "these pairs.",
    )
    common_random_numbers: Switch = Field(
        description="Whether the two members of a pair share resets and action noise."
    )

    presets = (
        # Our choice is sized for one machine. The papers used 5,000 to 10,000 episodes a generation, so compare results
        # at equal environment steps. A pair that shares resets and action noise differs by less noise.
        PresetRow("search.pairs", 512, 5000, "literature: our choice. uber: ME-ES, 10,000 episodes in + and - pairs."),
        PresetRow("search.common_random_numbers", True, False, "literature: our choice. uber: ME-ES."),
    )
    gathers_statistics = True
    spread_by = ("search.sigma", "search.step.learning_rate")
    unused = ()

    def populations(self) -> int:
        """One population, unless a method has several."""
        return 1


class CandidatesConfig(PopulationConfig):
    """A search that starts from several policies of another run: its best centre, and elites of its map."""

    screened: CountAtOnce = Field(
        16,
        description="Policies of the run that `search.init_from` names, from which the search starts: the best "
        "centre and elites. Their first evaluation chooses `search.candidates` of them.",
    )
    candidates: Count = Field(4, description="Policies that remain after the first evaluation.")
    candidate_choice: Literal["fitness", "novelty", "place"] = Field(
        "fitness",
        description="Which elites these are. `fitness`: the fittest. `novelty`: the most novel, in the novelty "
        "archive of that run. `place`: those nearest to the middle of the target set of `search.objective`.",
    )
    objective: Objective = Field(
        FitnessObjective(),
        discriminator="kind",
        description="What members are ranked by, and candidates. `fitness`: what `task.fitness` says. `return`: the "
        "sum of the rewards. `final`: the reward of the last step. `goal_distance`: how near to the goal an episode "
        "ends. `novelty`: novelty. `mixture`: novelty and fitness. `target`: fitness among those that end in a set of "
        "descriptors, before all others, which rank by their distance from it. `nearness`: nearness to a descriptor, "
        "and fitness.",
    )

    only_centres = "search.screened"
    needs_start = "which improves policies of another run"

    def populations(self) -> int:
        """One for each candidate."""
        return self.candidates

    def spread_keys(self) -> tuple[str, ...]:
        """The key that makes more populations."""
        return ("search.candidates",)

    def outputs(self) -> tuple[str, ...]:
        """What the objective reads."""
        return outputs_of([self.objective])
