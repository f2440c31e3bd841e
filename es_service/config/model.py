"""The resolved, frozen config of a run, and the part of it that can never change once the run exists.

A `RunConfig` contains no `auto` that would affect results. It is made by `loading.read` and not by hand: that fills in
presets, defaults and shapes and checks the sections against each other.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from pydantic import Field, PrivateAttr, SerializeAsAny

from es_service.config.parts import (
    TASK_OPTIONS,
    BoundPairs,
    CellCounts,
    Count,
    Descriptor,
    NotNegative,
    Number,
    Options,
    Patience,
    Positive,
    Section,
    Seed,
    Switch,
    Text,
    Widths,
)
from es_service.config.search import SearchConfig
from es_service.config.text import dump_yaml
from es_service.protocol.messages import HostChoices, TaskSpec
from es_service.protocol.policy_spec import Activation, Output
from es_service.protocol.sources import task_code


class TaskConfig(Section):
    """The task that is to be learned. Constants of the run."""

    environment: Text = Field(
        description="Name of the task: a shipped one, brax:NAME, mujoco:ID, gymnasium:ID, gymnax:NAME, "
        "playground:NAME, or one of your own: module:Class in JAX, python:module:Class, or function:module:name."
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
    success: Text | None = Field(
        None,
        description="For tasks of Python objects: key of the last step's info that says whether an episode has "
        "succeeded. null: as the task says, or is_success.",
    )
    new_object_each_episode: Switch = Field(
        False,
        description="For tasks of Python objects: whether each episode has a new object, for simulators that carry "
        "something over from one episode to the next. `es-service doctor TASK` finds whether they do.",
    )
    recycle_after_episodes: Count | None = Field(
        None,
        description="For tasks of Python objects and functions: each worker is replaced by a new process after this "
        "many episodes, for simulators that leak. null: never. It changes no result, and may change on resume.",
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
    def choices(self) -> HostChoices:
        """What is chosen for a task of Python objects."""
        return HostChoices(self.descriptor, self.success, self.new_object_each_episode)

    @property
    def code(self) -> tuple[str, ...]:
        """`sources.task_code` of the task."""
        return task_code(self.environment, self.descriptor, self.options)


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
        "no limit. The archive keeps the others, too.",
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
    rollout_s: Positive | None = Field(
        None,
        description="Seconds in which workers compute, summed over all sessions: without their starting and compiling, "
        "waits for them, and the time between generations. The generation that reaches it is the last.",
    )
    cpu_s: Positive | None = Field(
        None,
        description="Seconds of the processors of the driver and of all its workers, starting and compiling included, "
        "summed over all sessions. The generation that reaches it is the last. Engine inline.",
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


class WorkerResources(Section):
    """Resources of one worker."""

    cpu: Literal["auto"] | Count = Field(
        "auto",
        description="Cores of each Ray actor, all of which it uses. auto: those of a node if the nodes are equal, so "
        "that a node needs few messages, else 1; with a GPU 1. It never changes results.",
    )
    gpu: NotNegative = Field(
        0.0,
        description="GPUs of each worker. With a fraction below 1, workers share a GPU; with 0, episodes run on the "
        "CPU. With rollout xla, a GPU has bits of its own.",
    )


class ComputeConfig(Section):
    """How the work is divided and where it runs. Only `rollout` and the three `*_pairs` are constants of the run."""

    engine: Literal["ray", "inline"] = Field(
        description="How the workers run. inline: as child processes of this program. ray: as Ray actors, on this "
        "machine or in a cluster. auto: ray if an address is given or actors have several cores, else inline, which "
        "starts sooner and sends messages faster."
    )
    inline_workers: Literal["processes", "threads"] = Field(
        "processes",
        description="With engine inline: whether each worker is a process, or all workers are threads of one process. "
        "Threads need rollout simd and take less memory, but if one worker crashes, all are lost.",
    )
    address: Text | None = Field(
        None,
        description="With engine ray: address of the cluster to connect to, HOST:PORT, or auto for the cluster on this "
        "machine; null starts a Ray instance for this run.",
    )
    workers: Literal["auto"] | Count = Field(
        "auto",
        description="Number of workers, each of which is a core, or with GPUs its share of them. auto: every core of "
        "the machine or cluster that has work, or with the engine inline and GPUs as many as these have room for; with "
        "a number in worker_resources.cpu, it also asks the cluster for more. No more start than there is work for, in "
        "whole actors. It never changes results.",
    )
    platform: Literal["any", "x86_64", "aarch64"] = Field(
        "any",
        description="Architecture of the processors that work for the run; a worker on another one is refused. any: "
        "all. What computed the run is recorded, and its digest is marked mixed once there are several kinds.",
    )
    max_workers_per_core: Count = Field(
        4,
        description="Most workers for each core where all workers are on this machine; a larger number of workers is "
        "refused. Raise it only for a task whose steps wait for something outside, such as another program.",
    )
    worker_resources: WorkerResources = Field(
        default_factory=lambda: WorkerResources(cpu="auto", gpu=0.0),
        description="Resources of one worker, which Ray reserves for its actor if the engine is ray.",
    )
    rollout: Text = Field(
        description="How episodes are computed. simd: by code compiled for this kind of processor or GPU, about twenty "
        "times faster. xla: by JAX, for tasks that simd cannot compile. host: by the Python code of a task "
        "that is not in JAX. auto: the fastest that can."
    )
    chunk_pairs: Count = Field(
        description="Pairs in one chunk; must divide search.pairs. auto: the largest divisor of search.pairs up to an "
        "eighth of it (this limit is at least 16 and at most 64), and a multiple of 8 if there is one."
    )
    rollout_block_pairs: Count = Field(
        description="With rollout xla: pairs whose episodes step together, so that their weights stay in the cache; "
        "must divide chunk_pairs. auto: the largest divisor of chunk_pairs up to 32 whose weights take at most 5 MiB."
    )
    gradient_block_pairs: Count = Field(
        description="Pairs summed into one partial gradient; at most search.pairs. auto: the smallest number of whole "
        "chunks that gives at most 32 blocks and makes each block large enough to be worth a message."
    )
    chunk_timeout_s: Positive = Field(
        30.0,
        description="Shortest deadline of a chunk in seconds; slow chunks make the deadline of later chunks longer, "
        "and each attempt may take twice as long as the one before. It counts anew whenever a worker reports progress.",
    )
    first_chunk_timeout_s: Positive = Field(
        120.0,
        description="Deadline in seconds of a chunk while it is not known how long chunks of its kind take, which is "
        "until the first one is done; at least chunk_timeout_s. Compilation does not count.",
    )
    compile_timeout_s: Positive = Field(
        120.0,
        description="Deadline in seconds for the compilation that a worker does before its first chunk of each kind; "
        "for a task of Python objects, longest time in which one of them must be made or reset.",
    )
    max_attempts: Count = Field(4, description="Attempts to compute a chunk before the run stops with its error.")
    place_timeout_s: Positive | None = Field(
        None,
        description="With engine ray in a cluster: longest time in seconds for which the run waits for a first place, "
        "before it stops; null: as long as it takes.",
    )
    no_worker_timeout_s: Patience = Field(
        120.0,
        description="Seconds without a live worker, after the first had come up, after which the run stops. A worker "
        "that has not started after half of this time is replaced; on a busy machine a start takes up to ten seconds.",
    )
    parent_cache_mb: Count = Field(
        256,
        description="Most MiB of elites' parameters that each worker keeps, of which it makes the policies of "
        "map_elites; what it does not keep is sent again. It never changes results.",
    )
    worker_memory_mb: Count | None = Field(
        None,
        description="MiB of memory, its simulators included, above which a worker is replaced by a new process once it "
        "has computed what it was sent; an actor with several cores has as much for each. null: no limit. It changes "
        "no result.",
    )
    worker_output_bytes: Count = Field(
        2**20,
        description="About how many bytes are kept of what each worker prints, its simulators included: the newest. "
        "The last lines are told if the worker is lost.",
    )
    dispatch_log: Switch = Field(
        False,
        description="Whether the run folder gets a dispatch.jsonl: what was sent to each worker, what it answered, and "
        "why it was lost.",
    )


COMPUTE_CONSTANTS = ("rollout", "chunk_pairs", "rollout_block_pairs", "gradient_block_pairs")
"""Keys of `compute` that affect floating-point results and are therefore constants of the run."""
RECYCLING = "task.recycle_after_episodes"
"""The key of `task` that changes no result."""
ENGINE_IMPLIES: dict[str, dict[str, Any]] = {
    "inline": {"compute.address": None, "compute.worker_resources.cpu": "auto"},
    "ray": {"compute.inline_workers": "processes"},
}
"""Engine -> settings that only the other engine uses, with the values that they must have with this one."""


def implied_by(engine: str | None, address: str | None) -> dict[str, Any]:
    """Settings that a choice of the engine or of a cluster's address implies; None: no choice."""
    if address is None:
        return ENGINE_IMPLIES.get(engine or "", {})
    return ENGINE_IMPLIES["ray"] | ({} if engine else {"compute.engine": "ray"})  # only a Ray cluster can be joined


@dataclass(frozen=True)
class Kept:
    """A value that a config gives to a key, although what it was written for has been replaced."""

    value: Any
    default: Any
    """What the key would have without it."""
    replaced: str
    """The key that overrides have changed: `search.algorithm`, or the kind of a part."""
    by: str
    """The value of that key now."""

    @property
    def why(self) -> str:
        """What is replaced, as a clause."""
        return replaces(self.replaced, self.by)


def replaces(key: str, value: Any) -> str:
    """A clause that says which value replaces that of a config file."""
    return f"{value} replaces its {'algorithm' if key == 'search.algorithm' else key}"


@dataclass(frozen=True)
class Made:
    """What a config was made from."""

    task: TaskSpec
    """The task from which values that were left open were resolved, with the descriptor that its options choose."""
    given: Mapping[str, Any] = field(compare=False)
    """What was given, by dotted key."""
    left_out: Mapping[str, str] = field(compare=False)
    """Keys of the file that go with the task, the method or the kind of a part that overrides have replaced, or whose
    values the new method does not allow; each with a clause that says so."""
    kept: Mapping[str, Kept] = field(compare=False)
    """Keys of the file that keep their values although overrides replace the method, or the kind of a part, for which
    they were written, and the new one has another default."""


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
    _made: Made | None = PrivateAttr(None)

    def made_of(self, made: Made) -> RunConfig:
        """The same config, which knows what it was made from."""
        config = self.model_copy()
        config._made = made
        return config

    @property
    def made(self) -> Made:
        """What the config was made from."""
        if self._made is None:
            raise ValueError("this config was not loaded; load it with load_config")
        return self._made

    def resolved_yaml(self) -> str:
        """The text of the run folder's `config.yaml`, with every value. Loading it gives an equal config."""
        return dump_yaml(self.model_dump(mode="json"))

    def given_yaml(self, changes: Mapping[str, Any]) -> str:
        """The text of a config file that gives what this config was given, with some values changed by dotted key. This
        version makes the same config of it on this machine."""
        return dump_yaml(nested({**self.made.given, **changes}))

    def constants(self) -> dict[str, Any]:
        """Values that resume must not change: dotted key -> plain JSON value, in the order of the config."""
        return {key: value for key, value in flat(self.model_dump(mode="json")).items() if is_constant(key)}


def is_constant(key: str) -> bool:
    """Whether resume must not change the value of a key."""
    section, _, name = key.partition(".")
    if key == RECYCLING:
        return False
    return section not in ("budget", "store") and (section != "compute" or name in COMPUTE_CONSTANTS)


def flat(sections: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested mappings: {"search": {"sigma": 0.02}} -> {"search.sigma": 0.02}. An option that is a mapping is a
    value."""
    values: dict[str, Any] = {}
    for key, value in sections.items():
        is_group = isinstance(value, Mapping) and prefix != TASK_OPTIONS
        values |= flat(value, f"{prefix}{key}.") if is_group else {f"{prefix}{key}": value}
    return values


def nested(values: Mapping[str, Any], sections: Iterable[str] = ()) -> dict[str, Any]:
    """Nested mappings from dotted keys, the inverse of `flat`; with these sections, even if they are empty."""
    whole: dict[str, Any] = {section: {} for section in sections}
    for name, value in values.items():
        *path, leaf = name.split(".")
        target = whole
        for group in path:
            target = target.setdefault(group, {})
        target[leaf] = value
    return whole
