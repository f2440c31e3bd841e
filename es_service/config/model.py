"""The resolved, frozen config of a run, and the part of it that can never change once the run exists.

A `RunConfig` contains no `auto` that would affect results. Create it with `loading.load_config` and not by hand:
`load_config` fills in presets, defaults and shapes and checks the sections against each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field

from es_service.config.compute import COMPUTE_CONSTANTS, ComputeConfig
from es_service.config.fields import (
    BoundPairs,
    CellCounts,
    Count,
    Fraction,
    NotNegative,
    Number,
    Positive,
    Section,
    Seed,
    Switch,
    Text,
    Widths,
)
from es_service.config.yaml_text import dump_yaml
from es_service.protocol.messages import PolicyShape, TaskSpec, WorkerSpec


class TaskConfig(Section):
    """The task that is to be learned. Constants of the run."""

    environment: Text = Field(
        description="Name of the task: a shipped one, brax:NAME, or module:Class for one of your own."
    )
    episode_steps: Count = Field(description="Length of an episode in control steps. null: the task's own length.")
    fitness: Literal["sum", "final"] = Field(
        "sum",
        description="What selection maximises: the sum of an episode's rewards, or the reward of its last valid step "
        "(only where the task declares that this makes sense).",
    )
    episodes_per_member: Count = Field(
        1, description="Training episodes of each member of the population; its fitness is their mean."
    )
    options: dict[Text, Text] = Field(
        default_factory=dict,
        description="Settings of the task, such as `start`; the default of each is its first allowed value.",
    )


class PolicyConfig(Section):
    """The controller: a tanh multilayer perceptron with outputs in [-1, 1]. Constants of the run."""

    hidden: Widths = Field((64, 64), description="Widths of the hidden layers; [] is a linear policy under a tanh.")
    init: Literal["unit_columns", "small_columns"] = Field(
        description="Initial weights: Gaussian columns scaled to a norm, biases 0. unit_columns: norm 1.0 in hidden "
        "layers, 0.01 in the output layer. small_columns: 0.01 in every layer. Set by the preset."
    )
    observation_normalization: Switch = Field(
        True,
        description="Whether observations are shifted and scaled by the running statistics of the training. "
        "map_elites, which has none, allows only false, its default.",
    )
    observation_clip: Positive | None = Field(
        description="Bound on each normalised observation, in standard deviations; null for none. Set by the preset; "
        "a preset sets null where normalisation is off."
    )
    action_noise: NotNegative = Field(
        0.01,
        description="Standard deviation of the Gaussian noise added to actions in training episodes, in action units.",
    )


class SearchConfig(Section):
    """The evolution strategy. Constants of the run."""

    algorithm: Text = Field(
        description="Name of the search algorithm: a shipped one, or module:function for one of your own."
    )
    preset: Literal["literature", "uber"] = Field(
        "literature", description="Which column of the preset table fills in the keys that the config leaves out."
    )
    pairs: Count = Field(
        description="Antithetic pairs of a population, which has twice as many members. A generation has one "
        "population, or one for each centre with search.emitters and search.update: all. Set by the preset."
    )
    sigma: Positive = Field(0.02, description="Standard deviation of the parameter noise, in parameter units.")
    learning_rate: Positive = Field(0.01, description="Step size of Adam, in parameter units.")
    l2: NotNegative = Field(
        0.005, description="Weight decay, added to the gradient before Adam: lambda in -g + lambda x."
    )
    centres: Count = Field(
        description="Number of centres searched side by side, each with its own optimiser. auto: 1 for es, "
        "search.emitters for me_es and memes (these allow no other number), 32 for map_elites, whose first random "
        "policies they are, 1 for a search of your own; else 5."
    )
    update: Literal["one", "all"] = Field(
        "one",
        description="ns_es, nsr_es, nsra_es: how many of the centres a generation updates. one: that of "
        "search.centre_choice. all: every centre, with search.pairs pairs each.",
    )
    centre_choice: Literal["novelty", "round_robin", "uniform"] = Field(
        "novelty",
        description="How the centre to update is chosen. novelty: with probability proportional to its novelty. "
        "round_robin: in turn. uniform: all with the same probability.",
    )
    emitters: Count = Field(
        1,
        description="me_es: number of blocks that run side by side, with search.pairs pairs each in every generation. "
        "memes: number of evolution strategies, likewise; 16 if left out.",
    )
    fitness_weight_start: Fraction = Field(
        description="nsra_es: weight of fitness beside novelty at the start. Set by the preset."
    )
    fitness_weight_step: Fraction = Field(
        0.05, description="nsra_es: how much the weight of fitness rises after an improvement or falls in stagnation."
    )
    fitness_weight_patience: Count = Field(
        description="nsra_es: generations without improvement before the weight of fitness falls. Set by the preset."
    )
    fitness_weight_min_gain: NotNegative = Field(
        description="nsra_es: a centre is an improvement if its fitness exceeds the record by more than this fraction "
        "of the record's absolute value. Set by the preset."
    )
    mode: Literal["explore_exploit", "explore", "exploit"] = Field(
        "explore_exploit",
        description="me_es: what a block of generations maximises. explore: novelty. exploit: fitness. "
        "explore_exploit: one of the two, as search.alternation says. memes: what an emitter maximises; "
        "explore_exploit: novelty and fitness by turns, beginning with novelty for the first emitter.",
    )
    alternation: Literal["round_robin", "coin"] = Field(
        "round_robin",
        description="me_es: how exploring and exploiting blocks follow each other. round_robin: in turn. coin: each "
        "block is chosen at random, with probability 1/2.",
    )
    first_block: Literal["explore", "exploit"] = Field(
        description="me_es: what the first block does with alternation round_robin. Set by the preset."
    )
    block_generations: Count = Field(
        10,
        description="me_es: generations in a block; each block starts from an elite drawn from the map, with a fresh "
        "optimiser.",
    )
    cell_sampling: Literal["top", "score"] = Field(
        description="me_es: how the cell of that elite is drawn: as in QDax (top) or as in the released code (score); "
        "es_service/search/algorithms/me_es.py describes both. Set by the preset."
    )
    stagnation_generations: Count = Field(
        32,
        description="memes: generations after which an emitter none of whose centres has entered the map since then "
        "begins again from an elite, with a fresh optimiser.",
    )
    parent_statistics: Literal["global", "elite"] = Field(
        "global",
        description="me_es, memes: observation statistics that a block uses. global: those of the whole run. elite: "
        "those with which the elite at its start was evaluated. With elite, all elites descend from the first centre "
        "and keep its statistics, so observations are not normalised unless the run started from a policy of another "
        "run.",
    )
    batch: Count = Field(256, description="map_elites: number of policies that a generation makes and evaluates.")
    iso_sigma: NotNegative = Field(
        0.005, description="map_elites: standard deviation of the noise in each parameter, in parameter units."
    )
    line_sigma: NotNegative = Field(
        0.05,
        description="map_elites: standard deviation of the step along the line through both parents, as a share of the "
        "distance between them.",
    )
    evaluation_episodes: Count = Field(
        30,
        description="Noise-free episodes on which each new centre is evaluated; they count as environment steps. "
        "memes, and map_elites for each policy: 1 if left out.",
    )
    common_random_numbers: Switch = Field(
        description="Whether the two members of a pair share resets and action noise. Set by the preset."
    )
    max_invalid_fraction: Fraction = Field(
        0.5, description="Share of members with a non-finite fitness or descriptor above which the run stops."
    )
    init_from: Text | None = Field(
        None,
        description="Policy of another run from which this run starts: RUN (its folder) for the centre updated last, "
        "RUN:best for the best centre, or RUN:3,17 for a cell's elite; null for random weights.",
    )


class NoveltyConfig(Section):
    """How novelty is measured. Constants of the run."""

    neighbours: Count = Field(
        10, description="Novelty is the mean distance to this many nearest entries of the novelty archive."
    )
    distance: Literal["euclidean", "squared_euclidean"] = Field(
        description="Distance between descriptors. Set by the preset."
    )
    newest: Count | None = Field(
        None,
        description="Number of the newest entries of the novelty archive with which a descriptor is compared; null: "
        "all. The archive keeps the others, too.",
    )


class MapConfig(Section):
    """The behaviour map, in which each cell keeps the fittest evaluated centre. Constants of the run."""

    enabled: Switch = Field(True, description="Whether the run fills a map; me_es, memes and map_elites need one.")
    kind: Literal["grid", "cvt"] = Field(
        description="grid: cells of equal size. cvt: any number of cells around centroids, for many dimensions. auto: "
        "grid for up to six dimensions, else cvt."
    )
    bounds: BoundPairs = Field(
        description="[low, high] for each dimension of the descriptor; descriptors outside belong to the border cells. "
        "auto: the bounds of the task."
    )
    cells: CellCounts = Field(
        description="grid: number of cells along each dimension. cvt: one number, the number of all cells. auto: [100] "
        "for one dimension, [20, 20] for two, at most 10,000 cells in all for more; [1024] for a cvt."
    )
    qd_offset: Number = Field(
        description="Fitness that counts as 0 in the QD-score. auto: the lowest reward of the task, times the steps of "
        "an episode with fitness sum; 0 if the task specifies no lowest reward."
    )


class BudgetConfig(Section):
    """Limits at which the run stops; the first one reached ends it. At least one is set. May change on resume."""

    generations: Count | None = Field(None, description="Number of generations, summed over all sessions.")
    env_steps: Count | None = Field(None, description="Number of environment steps, evaluations included.")
    wall_clock_s: Positive | None = Field(None, description="Running time in seconds, summed over all sessions.")
    target_fitness: Number | None = Field(None, description="Mean evaluation fitness of a centre that ends the run.")


class RunConfig(Section):
    """The config of a whole run. Equal configs give equal results, wherever and however often they run."""

    task: TaskConfig
    policy: PolicyConfig
    search: SearchConfig
    novelty: NoveltyConfig
    map: MapConfig
    budget: BudgetConfig
    compute: ComputeConfig
    seed: Seed = Field(0, description="Seed of all random numbers of the run.")

    def resolved_yaml(self) -> str:
        """The text of the run folder's `config.yaml`, with every value. Loading it gives an equal config."""
        return dump_yaml(self.model_dump(mode="json"))

    def constants(self) -> dict[str, Any]:
        """Values that resume must not change: dotted key -> plain JSON value, in the order of the config."""
        sections = self.model_dump(mode="json")
        del sections["budget"]
        sections["compute"] = {key: sections["compute"][key] for key in COMPUTE_CONSTANTS}
        return flat(sections)


def flat(sections: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested mappings: {"search": {"sigma": 0.02}} -> {"search.sigma": 0.02}."""
    values: dict[str, Any] = {}
    for key, value in sections.items():
        values |= flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return values


def policy_shape(config: RunConfig, task: TaskSpec) -> PolicyShape:
    """Shape of the policy network, from the task's observation to its action."""
    return PolicyShape((task.observation_size, *config.policy.hidden, task.action_size))


def worker_spec(config: RunConfig, task: TaskSpec) -> WorkerSpec:
    """The message that every worker of the run receives once, when it starts."""
    settings, policy, compute = config.task, config.policy, config.compute
    return WorkerSpec(
        seed=config.seed,
        environment=settings.environment,
        environment_options=dict(settings.options),
        policy=policy_shape(config, task),
        episode_steps=settings.episode_steps,
        fitness=settings.fitness,
        episodes_per_member=settings.episodes_per_member,
        observation_clip=policy.observation_clip,
        action_noise=policy.action_noise,
        common_random_numbers=config.search.common_random_numbers,
        chunk_pairs=compute.chunk_pairs,
        rollout_block_pairs=compute.rollout_block_pairs,
        gradient_block_pairs=compute.gradient_block_pairs,
        rollout=compute.rollout,
    )
