"""The resolved, frozen config of a run, and the part of it that can never change once the run exists.

A `RunConfig` contains no `auto` that would affect results. Create it with `loading.load_config` and not by hand:
`load_config` fills in presets, defaults and shapes and checks the sections against each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field, PrivateAttr, SerializeAsAny

from es_service.config.caller import CALLER
from es_service.config.compute import COMPUTE_CONSTANTS, ComputeConfig
from es_service.config.fields import (
    TASK_OPTIONS,
    BoundPairs,
    CellCounts,
    Count,
    Descriptor,
    NotNegative,
    Number,
    Options,
    Positive,
    Section,
    Seed,
    Switch,
    Text,
    Widths,
)
from es_service.config.search import PopulationConfig, SearchConfig
from es_service.config.yaml_text import dump_yaml
from es_service.errors import ConfigError
from es_service.protocol.messages import PolicySpec, TaskSpec, WorkerSpec
from es_service.protocol.policy_spec import Activation, Output
from es_service.protocol.sources import task_code, worker_sources


class TaskConfig(Section):
    """The task that is to be learned. Constants of the run."""

    environment: Text = Field(
        description="Name of the task: a shipped one, brax:NAME, mujoco:ID, gymnasium:ID, or one of your own: "
        "module:Class in JAX, python:module:Class, or function:module:name."
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
    descriptor: Descriptor | None = Field(
        None,
        description="Descriptor of an episode, for tasks of Python objects. A list, such as [0, 1]: these numbers of "
        "the last observation. A name: this key of the last step's info. module:function: a function of the episode. "
        "null: that of the task.",
    )
    time_limit_s: Positive | None = Field(
        None,
        description="Longest time in seconds of a chunk of episodes, for tasks of Python objects, or of a call of a "
        "function, which is then invalid. null: chunks have a deadline that follows their usual time, and calls none.",
    )
    options: Options = Field(
        default_factory=dict, description="Settings of the task, such as `start`, which the task declares."
    )

    @property
    def code(self) -> tuple[str, ...]:
        """`sources.task_code` of the task."""
        return task_code(self.environment, self.descriptor)


class PolicyConfig(Section):
    """The controller: a multilayer perceptron, perhaps with a memory. Constants of the run."""

    hidden: Widths = Field((64, 64), description="Widths of the hidden layers; [] is a linear policy under its output.")
    activation: Activation = Field("tanh", description="Function after each hidden layer.")
    memory: Count | None = Field(
        None, description="Units of a gated recurrent cell (GRU) between the hidden layers and the last; null: none."
    )
    output: Output = Field(
        "tanh",
        description="What makes an action of the last layer: tanh; linear, the numbers themselves; argmax, 1 for the "
        "greatest and 0 for the others; categorical, the same drawn by softmax probabilities; gaussian, tanh of a "
        "normal variate with a mean and a spread of the last layer. Evaluations take the most probable action.",
    )
    bias: Switch = Field(True, description="Whether layers have biases.")
    init: Literal["unit_columns", "small_columns"] = Field(
        description="Initial weights: Gaussian columns scaled to a norm, biases 0. unit_columns: norm 1.0 in hidden "
        "layers, 0.01 in the output layer. small_columns: 0.01 in every layer. Set by the preset."
    )
    observation_normalization: Switch = Field(
        True,
        description="Whether observations are shifted and scaled by the running statistics of the training. A method "
        "without training episodes allows only false, its default.",
    )
    observation_clip: Positive | None = Field(
        description="Bound on each normalised observation, in standard deviations; null for none. Set by the preset; "
        "a preset sets null where normalisation is off."
    )
    action_noise: NotNegative = Field(
        0.01,
        description="Standard deviation of the Gaussian noise added to actions in training episodes, in action units. "
        "Only outputs tanh and linear have it; for others it is 0.",
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

    enabled: Switch = Field(True, description="Whether the run fills a map; some methods need one.")
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
    centroids: Literal["lloyd", "kmeans"] = Field(
        "lloyd",
        description="Of kind cvt: how the centroids are placed. lloyd: by 20 steps of Lloyd's algorithm on 50 random "
        "places for each. kmeans: by SciPy's k-means on 10 places for each, which is faster and less even.",
    )
    qd_offset: Number = Field(
        description="Fitness that counts as 0 in the QD-score. auto: the lowest reward of the task, times the steps of "
        "an episode with fitness sum; 0 if the task specifies no lowest reward: elites of negative fitness then lower "
        "the score as the map fills; reports also draw it from the least fitness evaluated."
    )
    correct_every: Count | None = Field(
        None,
        description="All elites are evaluated in new episodes after each generation whose number is a multiple of "
        "this, for the corrected columns of the history. These episodes count as environment steps; the search learns "
        "nothing from them. null: never, and no such columns.",
    )
    correct_episodes: Count = Field(32, description="Episodes of each elite there.")


class BudgetConfig(Section):
    """Limits at which the run stops; the first one reached ends it. At least one is set. May change on resume."""

    generations: Count | None = Field(None, description="Number of generations, summed over all sessions.")
    env_steps: Count | None = Field(None, description="Number of environment steps, evaluations included.")
    wall_clock_s: Positive | None = Field(
        None,
        description="Running time in seconds, summed over all sessions, from the start of workers on: with their "
        "starting and compiling, but without a wait for a first place in a cluster, certifications, and the time "
        "between a stop and a resume.",
    )
    target_fitness: Number | None = Field(None, description="Mean evaluation fitness of a centre that ends the run.")
    target_certified: Number | None = Field(
        None,
        description="Mean fitness in 256 new episodes that ends the run: they decide on the best centre when its "
        "evaluation reaches this, and the run continues if they do not. Its certified value is that of further "
        "episodes.",
    )


class StoreConfig(Section):
    """What the run folder keeps besides the newest state. May change on resume."""

    keep_every: Count | None = Field(
        None,
        description="The states of generations whose number is a multiple of this are kept, so that a later check can "
        "compute from them and a fork can begin there; null keeps only those of the last two generations.",
    )


class RunConfig(Section):
    """The config of a whole run. Equal configs give equal results, wherever and however often they run."""

    task: TaskConfig
    policy: PolicyConfig
    search: SerializeAsAny[SearchConfig]
    novelty: NoveltyConfig
    map: MapConfig
    budget: BudgetConfig
    compute: ComputeConfig
    store: StoreConfig
    seed: Seed = Field(0, description="Seed of all random numbers of the run.")
    _task: TaskSpec | None = PrivateAttr(None)

    def made_for(self, task: TaskSpec | None) -> RunConfig:
        """The same config, which knows the task from which its values were resolved."""
        config = self.model_copy()
        config._task = task
        return config

    @property
    def resolved_with(self) -> TaskSpec | None:
        """The task from which values that were left open were resolved; None if it is not known."""
        return self._task

    def resolved_yaml(self) -> str:
        """The text of the run folder's `config.yaml`, with every value. Loading it gives an equal config."""
        return dump_yaml(self.model_dump(mode="json"))

    def constants(self) -> dict[str, Any]:
        """Values that resume must not change: dotted key -> plain JSON value, in the order of the config."""
        sections = self.model_dump(mode="json")
        del sections["budget"], sections["store"]
        sections["compute"] = {key: sections["compute"][key] for key in COMPUTE_CONSTANTS}
        return flat(sections)


def flat(sections: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested mappings: {"search": {"sigma": 0.02}} -> {"search.sigma": 0.02}. An option that is a mapping is a
    value."""
    values: dict[str, Any] = {}
    for key, value in sections.items():
        is_group = isinstance(value, Mapping) and prefix != TASK_OPTIONS
        values |= flat(value, f"{prefix}{key}.") if is_group else {f"{prefix}{key}": value}
    return values


def policy_spec(config: RunConfig, task: TaskSpec) -> PolicySpec:
    """The policy of a run, from the task's observation to its action."""
    policy, widths = config.policy, (task.observation_size, *config.policy.hidden, task.action_size)
    return PolicySpec(widths, policy.activation, policy.output, policy.bias, policy.memory or 0)


def require_episodes(task: TaskSpec, *, asks_caller: bool) -> None:
    """Raise ConfigError if a task has no episodes of its own, and the caller is not asked for them."""
    if task.kind == CALLER and not asks_caller:
        raise ConfigError(
            "the episodes of this run are those of the program that asks it, so the service can compute none; to "
            "continue it, that program calls es_service.ask_tell with the same config and folder",
            field="task.environment",
            value=CALLER,
        )


def worker_spec(
    config: RunConfig, task: TaskSpec, outputs: tuple[str, ...] = (), *, asks_caller: bool = False
) -> WorkerSpec:
    """The message that every worker of the run receives once, when it starts.

    Args:
        outputs: see `WorkerSpec.outputs`; those that the search reads are added.
        asks_caller: whether the caller computes the episodes of a task that has none of its own.

    Raises ConfigError as `require_episodes`.
    """
    require_episodes(task, asks_caller=asks_caller)
    settings, policy, compute, search = config.task, config.policy, config.compute, config.search
    return WorkerSpec(
        seed=config.seed,
        environment=settings.environment,
        environment_options=dict(settings.options),
        descriptor=settings.descriptor,
        allow_infeasible=search.allow_infeasible,
        time_limit_s=settings.time_limit_s,
        descriptor_size=0 if settings.descriptor is None else len(task.descriptor_names),
        policy=policy_spec(config, task),
        episode_steps=settings.episode_steps,
        fitness=settings.fitness,
        episodes_per_member=settings.episodes_per_member,
        observation_clip=policy.observation_clip,
        action_noise=policy.action_noise,
        common_random_numbers=not isinstance(search, PopulationConfig) or search.common_random_numbers,
        chunk_pairs=compute.chunk_pairs,
        rollout_block_pairs=compute.rollout_block_pairs,
        gradient_block_pairs=compute.gradient_block_pairs,
        rollout=compute.rollout,
        noise_rank=search.noise.rank if isinstance(search, PopulationConfig) else 0,
        outputs=tuple(sorted({*outputs, *search.outputs()})),
        parent_cache_bytes=compute.parent_cache_mb * 2**20,
        output_bytes=compute.worker_output_bytes,
        sources=worker_sources(*settings.code),
        platform=compute.platform,
    )
