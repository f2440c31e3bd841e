"""What a run is: the resolved, frozen config, and what of it can never change once the run exists.

A `RunConfig` holds no `auto` that would change results: `loading.load_config` fills in presets, defaults and
shapes and checks the sections against each other, so build one with it and not by hand.
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
    """What is to be learned. Constants of the run."""

    environment: Text = Field(description="Name of the task: one of ours, brax:NAME, or module:Class, one of your own.")
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
        description="The task's own settings, such as `start`; by default the first value of each.",
    )


class PolicyConfig(Section):
    """The controller: a tanh multilayer perceptron with outputs in [-1, 1]. Constants of the run."""

    hidden: Widths = Field((64, 64), description="Widths of the hidden layers; [] is a linear policy under a tanh.")
    init: Literal["unit_columns", "small_columns"] = Field(
        description="Initial weights: Gaussian columns scaled to a norm, biases 0. unit_columns: norm 1.0 in hidden "
        "layers, 0.01 in the output layer. small_columns: 0.01 in every layer. Set by the preset."
    )
    observation_normalization: Switch = Field(
        True, description="Whether observations are shifted and scaled by the running statistics of the training."
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
        description="Name of the search algorithm: one of ours, or module:function, one of your own."
    )
    preset: Literal["literature", "uber"] = Field(
        "literature", description="Which column of the preset table fills in the keys that the config leaves out."
    )
    pairs: Count = Field(
        description="Antithetic pairs per generation; the population is twice as large. Set by the preset."
    )
    sigma: Positive = Field(0.02, description="Standard deviation of the parameter noise, in parameter units.")
    learning_rate: Positive = Field(0.01, description="Step size of Adam, in parameter units.")
    l2: NotNegative = Field(
        0.005, description="Weight decay, added to the gradient before Adam: lambda in -g + lambda x."
    )
    centres: Count = Field(
        description="Centres searched side by side, each with its own optimiser; one is updated per generation. "
        "auto: 1 for es and me_es, which allow no other, and for one of your own, else 5."
    )
    centre_choice: Literal["novelty", "round_robin", "uniform"] = Field(
        "novelty",
        description="How the centre to update is chosen: with probability proportional to its novelty, in turn, or all "
        "alike.",
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
        description="nsra_es: an improvement beats the record by more than this fraction of its size. Set by the "
        "preset."
    )
    mode: Literal["explore_exploit", "explore", "exploit"] = Field(
        "explore_exploit",
        description="me_es: what a block of generations climbs: novelty (explore), fitness (exploit), or either.",
    )
    alternation: Literal["round_robin", "coin"] = Field(
        "round_robin", description="me_es: whether exploring and exploiting blocks take turns or a coin decides."
    )
    first_block: Literal["explore", "exploit"] = Field(
        description="me_es: what the first block does where they take turns. Set by the preset."
    )
    block_generations: Count = Field(
        10, description="me_es: generations between two draws from the map; each block has a fresh optimiser."
    )
    cell_sampling: Literal["top", "score"] = Field(
        description="me_es: how a cell is drawn, as QDax (top) or the released code (score) has it; "
        "es_service/search/algorithms/me_es.py says how. Set by the preset."
    )
    parent_statistics: Literal["global", "elite"] = Field(
        "global",
        description="me_es: observation statistics that a block runs with: those of the whole run, or those that the "
        "elite it began with was evaluated with. With elite, all elites descend from the first centre and so keep its "
        "statistics: none, unless the run started from another one.",
    )
    evaluation_episodes: Count = Field(
        30,
        description="Episodes without noise on which each new centre is judged; counted as environment steps.",
    )
    common_random_numbers: Switch = Field(
        description="Whether the two members of a pair share resets and action noise. Set by the preset."
    )
    max_invalid_fraction: Fraction = Field(
        0.5, description="Share of members with a non-finite fitness or descriptor above which the run stops."
    )
    init_from: Text | None = Field(
        None,
        description="Policy of another run that this one starts from: RUN, its folder, for the centre updated last, "
        "RUN:best, or RUN:3,17 for a cell's elite; null for random weights.",
    )


class NoveltyConfig(Section):
    """What is novel. Constants of the run."""

    neighbours: Count = Field(
        10, description="Novelty is the mean distance to this many nearest entries of the novelty archive."
    )
    distance: Literal["euclidean", "squared_euclidean"] = Field(
        description="Distance between descriptors. Set by the preset."
    )


class MapConfig(Section):
    """The behaviour map, whose cells keep the fittest evaluated centre each. Constants of the run."""

    enabled: Switch = Field(True, description="Whether the run fills a map; me_es needs one.")
    kind: Literal["grid", "cvt"] = Field(
        description="grid: cells of equal sides. cvt: as many cells as wanted, for many dimensions. auto: grid for up "
        "to six dimensions."
    )
    bounds: BoundPairs = Field(
        description="[low, high] for each dimension of the descriptor; what lies outside belongs to the border cells. "
        "auto: the task's own."
    )
    cells: CellCounts = Field(
        description="grid: cells along each dimension. cvt: one number, of all. auto: [20, 20] for two dimensions, "
        "10,000 in all at most for others; [1024] for cvt."
    )
    qd_offset: Number = Field(
        description="Fitness that counts as 0 in the QD-score. auto: the least reward of the task times its steps "
        "(fitness: sum), or 0 where the task names none."
    )


class BudgetConfig(Section):
    """When to stop: whichever comes first. At least one is set. May change on resume."""

    generations: Count | None = Field(None, description="Generations in all, sessions before a resume included.")
    env_steps: Count | None = Field(None, description="Environment steps in all, evaluations included.")
    wall_clock_s: Positive | None = Field(None, description="Seconds of running in all, sessions together.")
    target_fitness: Number | None = Field(None, description="Mean evaluation fitness of a centre that is good enough.")


class RunConfig(Section):
    """A whole run. Equal configs give equal results, wherever and however often they run."""

    task: TaskConfig
    policy: PolicyConfig
    search: SearchConfig
    novelty: NoveltyConfig
    map: MapConfig
    budget: BudgetConfig
    compute: ComputeConfig
    seed: Seed = Field(0, description="Address of all random numbers of the run.")

    def resolved_yaml(self) -> str:
        """The text of the run folder's `config.yaml`: every value spelled out; loading it gives an equal config."""
        return dump_yaml(self.model_dump(mode="json"))

    def constants(self) -> dict[str, Any]:
        """What resume must not change: dotted key -> plain JSON value, in the order of the config."""
        sections = self.model_dump(mode="json")
        del sections["budget"]
        sections["compute"] = {key: sections["compute"][key] for key in COMPUTE_CONSTANTS}
        return flat(sections)


def flat(sections: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one: {"search": {"sigma": 0.02}} -> {"search.sigma": 0.02}."""
    values: dict[str, Any] = {}
    for key, value in sections.items():
        values |= flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return values


def policy_shape(config: RunConfig, task: TaskSpec) -> PolicyShape:
    """The network between the task's observation and action."""
    return PolicyShape((task.observation_size, *config.policy.hidden, task.action_size))


def worker_spec(config: RunConfig, task: TaskSpec) -> WorkerSpec:
    """What every worker of the run is told once, when it starts."""
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
