"""The sections of a config but `search`, each a class whose fields are its keys.

A field's description is the text of its key: in the terminal, and in the guide configs/keys.md, which is made of them.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from es_service.config.parts import (
    BoundPairs,
    CellCounts,
    Count,
    Descriptor,
    Fraction,
    Metrics,
    NotNegative,
    Number,
    Options,
    Patience,
    Positive,
    Section,
    Switch,
    Text,
    Widths,
)
from es_service.protocol.messages import HostChoices
from es_service.protocol.policy_spec import Activation, Output
from es_service.protocol.sources import task_code


class TaskConfig(Section):
    """The task that is to be learned. Constants of the run."""

    environment: Text = Field(
        description="Name of the task: a shipped one, `brax:NAME`, `mujoco:ID`, `gymnasium:ID`, `craftax:NAME`, "
        "`gymnax:NAME`, `jumanji:NAME`, `kheperax:NAME`, `playground:NAME`, or one of your own: `module:Class` in JAX, "
        "`python:module:Class`, or `function:module:name`."
    )
    episode_steps: Count = Field(description="Length of an episode in control steps. `null`: the task's own length.")
    fitness: Literal["sum", "final"] = Field(
        "sum",
        description="What selection maximises. `sum`: the sum of an episode's rewards. `final`: the reward of its "
        "last valid step, only where the task declares that this makes sense.",
    )
    episodes_per_member: Count = Field(
        1, description="Training episodes of each member of the population; its fitness is their mean."
    )
    descriptor: Descriptor | None = Field(
        None,
        description="Descriptor of an episode, for tasks of Python objects. A list, such as [0, 1]: these numbers of "
        "the last observation. A name: this key of the last step's `info`. `module:function`: a function of the "
        "episode. `null`: that of the task.",
    )
    success: Text | None = Field(
        None,
        description="For tasks of Python objects: key of the last step's `info` that says whether an episode has "
        "succeeded. `null`: as the task says, or `is_success`.",
    )
    metrics: Metrics = Field(
        (),
        description="For tasks of Python objects: keys of the steps' `info` that the run records as columns "
        "`metric_KEY`, means over the evaluation episodes. `KEY` is the last value in an episode; `KEY:sum`, "
        "`KEY:mean`, `KEY:min` and `KEY:max` are made of all its values.",
    )
    new_object_each_episode: Switch = Field(
        False,
        description="For tasks of Python objects: whether each episode has a new object, for simulators that carry "
        "something over from one episode to the next. `es-service doctor TASK` finds whether they do.",
    )
    recycle_after_episodes: Count | None = Field(
        None,
        description="For tasks of Python objects and functions: each worker is replaced by a new process after this "
        "many episodes, for simulators that leak. `null`: never. It changes no result, and may change on resume.",
    )
    time_limit_s: Positive | None = Field(
        None,
        description="Longest time in seconds of a chunk of episodes, for tasks of Python objects, or of a call of a "
        "function, which is then invalid. `null`: chunks have a deadline that follows their usual time, and calls "
        "none.",
    )
    options: Options = Field(
        default_factory=dict,
        description="Settings of the task, such as `task.options.start`. The command `list` shows each with its "
        "values; a task of your own declares them.",
    )

    @property
    def choices(self) -> HostChoices:
        """What is chosen for a task of Python objects."""
        return HostChoices(self.descriptor, self.success, self.new_object_each_episode, self.metrics)

    @property
    def code(self) -> tuple[str, ...]:
        """`sources.task_code` of the task."""
        return task_code(self.environment, self.descriptor, self.options)


class PolicyConfig(Section):
    """The controller: a multilayer perceptron, perhaps with a memory. Constants of the run."""

    hidden: Widths = Field(
        (64, 64), description="Widths of the hidden layers; `[]` is a linear policy under its output."
    )
    activation: Activation = Field("tanh", description="Function after each hidden layer.")
    memory: Count | None = Field(
        None,
        description="Units of a gated recurrent cell (GRU) between the hidden layers and the last one; `null`: none. "
        "It runs with `xla`.",
    )
    output: Output = Field(
        "tanh",
        description="What makes an action of the last layer; the default is `argmax` where a task has actions to "
        "choose from. `tanh`: the tanh of each number. `linear`: the numbers themselves. `argmax`: 1 for the "
        "greatest and 0 for the others. `categorical`: the same, drawn by softmax probabilities. `gaussian`: tanh "
        "of a normal variate, whose mean and spread the last layer gives. Evaluations take the most probable "
        "action.",
    )
    bias: Switch = Field(True, description="Whether layers have biases.")
    init: Literal["unit_columns", "small_columns"] = Field(
        description="Initial weights: Gaussian columns scaled to a norm, biases 0. `unit_columns`: norm 1.0 in "
        "hidden layers, 0.01 in the output layer. `small_columns`: 0.01 in every layer."
    )
    observation_normalization: Switch = Field(
        True,
        description="Whether observations are shifted and scaled by the running statistics of the training. A method "
        "without training episodes allows only false, its default.",
    )
    observation_clip: Positive | None = Field(
        description="Bound on each normalised observation, in standard deviations; `null` for none. A preset sets "
        "`null` where normalisation is off."
    )
    action_noise: NotNegative = Field(
        0.01,
        description="Standard deviation of the Gaussian noise added to actions in training episodes, in action "
        "units. Evaluations have none. Only outputs `tanh` and `linear` have it; for others it is 0.",
    )


class NoveltyConfig(Section):
    """How novelty is measured. Constants of the run."""

    neighbours: Count = Field(
        10, description="Novelty is the mean distance to this many nearest entries of the novelty archive."
    )
    distance: Literal["euclidean", "squared_euclidean"] = Field(description="Distance between descriptors.")
    newest: Count | None = Field(
        None,
        description="Number of the newest entries of the novelty archive with which a descriptor is compared; "
        "`null`: no limit. The archive keeps the others, too.",
    )


class MapConfig(Section):
    """The behaviour map, in which each cell keeps the fittest evaluated centre. Constants of the run."""

    enabled: Switch = Field(True, description="Whether the run fills a map; some methods need one.")
    kind: Literal["grid", "cvt", "dominated"] = Field(
        description="`grid`: cells of equal size. `cvt`: any number of cells around centroids, for many dimensions. "
        "`dominated`: slots without a place; an elite stays by its distance from fitter ones. "
        "`auto`: `grid` for up to six dimensions, else `cvt`."
    )
    bounds: BoundPairs = Field(
        description="[low, high] for each dimension of the descriptor; descriptors outside belong to the border "
        "cells. `auto`: the bounds of the task."
    )
    cells: CellCounts = Field(
        description="`grid`: number of cells along each dimension. `cvt`: one number, the number of all cells. "
        "`dominated`: as for a grid, by which only coverage and QD-score are counted. "
        "`auto`: [100] for one dimension, [20, 20] for two, at most 10,000 cells in all for more; [1024] for a cvt."
    )
    slots: Count = Field(1024, description="Of kind `dominated`: number of elites that the map keeps, at most 4,096.")
    neighbours: Count = Field(
        3,
        description="Of kind `dominated`: an elite stays by the mean distance of its descriptor to those of this many "
        "nearest fitter ones, in units of the descriptor.",
    )
    centroids: Literal["lloyd", "kmeans"] = Field(
        "lloyd",
        description="Of kind `cvt`: how the centroids are placed. `lloyd`: by 20 steps of Lloyd's algorithm on 50 "
        "random places for each. `kmeans`: by SciPy's k-means on 10 places for each, which is faster and less even. "
        "For 1,024 cells in seven dimensions, 10 s and 1.3 s on a core of a Zen 4. What takes more than 2 s is "
        "said, and what would take more than 10 minutes is refused.",
    )
    qd_offset: Number = Field(
        description="Fitness that counts as 0 in the QD-score. `auto`: the lowest reward of the task, times the steps "
        "of an episode with `task.fitness: sum`; 0 if the task specifies no lowest reward. Elites of negative "
        "fitness then lower the score as the map fills. Reports also draw it from the least fitness evaluated."
    )
    correct_every: Count | None = Field(
        None,
        description="All elites are evaluated in new episodes after each generation whose number is a multiple of "
        "this, for the corrected columns of the history. These episodes count as environment steps; the search "
        "learns nothing from them. `null`: never, and no such columns.",
    )
    correct_episodes: Count = Field(32, description="Episodes of each elite there.")


class BudgetConfig(Section):
    """Limits at which the run stops; the first one reached ends it. At least one is set. May change on resume."""

    generations: Count | None = Field(None, description="Number of generations, summed over all sessions.")
    env_steps: Count | None = Field(None, description="Number of environment steps, evaluations included.")
    wall_clock_s: Positive | None = Field(
        None,
        description="Running time in seconds, summed over all sessions, from the start of workers on. It includes "
        "their starting and compiling. It does not include a wait for a first place in a cluster, certifications, "
        "and the time between a stop and a resume. No generation begins if the shortest of the last five (of at "
        "least two) would end after the limit; the end says by how much the limit was exceeded. A run that has no "
        "time for its first generation is not finished: `status`, `sweep` and `Outcome.is_finished` say so.",
    )
    rollout_s: Positive | None = Field(
        None,
        description="Seconds in which workers compute, summed over all sessions: without their starting and "
        "compiling, waits for them, and the time between generations. The generation that reaches it is the last; the "
        "end says by how much it was exceeded. Runs of several methods compared at equal seconds, or on a machine "
        "that is slow to start, have this budget.",
    )
    cpu_s: Positive | None = Field(
        None,
        description="Seconds of the processors of the driver and of all its workers, starting and compiling "
        "included, summed over all sessions. The generation that reaches it is the last; the end says by how much it "
        "was exceeded. Of an actor of Ray that was lost, it counts what it had used by its last answer; Ray's own "
        "processes do not count.",
    )
    target_fitness: Number | None = Field(None, description="Mean evaluation fitness of a centre that ends the run.")
    target_certified: Number | None = Field(
        None,
        description="Mean fitness in 256 new episodes that ends the run: they decide on the best centre when its "
        "evaluation reaches this, and the run continues if they do not. Its certified value is that of further "
        "episodes.",
    )


class StoreConfig(Section):
    """How generations are stored, and what the run folder keeps besides the newest state. May change on resume."""

    commit_interval_s: Fraction = Field(
        0.05,
        description="Generations that end within so many seconds are stored in one transaction, at most 1. `kill -9` "
        "loses at most these and the unfinished one, and the run computes them again with the same results. `0`: each "
        "is stored by itself. So it is in any case where results cannot be had again (`ask_tell`, rollout `host`), and "
        "where a program may stop the run after each generation (`on_generation`).",
    )

    keep_every: Count | None = Field(
        None,
        description="The states of generations whose number is a multiple of this are kept. The command `verify` can "
        "compute from them, a fork can begin there, and a damaged run can fall back to them. `null`: only those of "
        "the last two generations. A change applies to later generations; kept states before the last two remain.",
    )


class WorkerResources(Section):
    """Resources of one worker."""

    cpu: Literal["auto"] | Count = Field(
        "auto",
        description="With engine `ray`: cores of each actor, all of which it uses (with `simd` by threads, with `xla` "
        "by child processes). `auto`: in a cluster those of a node if all nodes have equally many, so that a node "
        "needs few messages; else 1. With a GPU, and with a Ray instance on this machine only, it is 1, too. It "
        "must divide `compute.workers`.",
    )
    gpu: NotNegative = Field(
        0.0,
        description="GPUs of each worker; with a fraction below 1, workers share a GPU, and with 0, episodes run on "
        "the CPU. With `xla` a GPU has bits of its own; a run that goes on without it is recorded as mixed.",
    )


class ComputeConfig(Section):
    """How the work is divided and where it runs. Only `rollout` and the three `*_pairs` are constants of the run."""

    engine: Literal["ray", "inline"] = Field(
        description="How the workers run. `inline`: as child processes of this program. `ray`: as Ray actors, on this "
        "machine or in a cluster. `auto`: `ray` if an address is given or actors have several cores, else `inline`, "
        "which starts sooner and sends messages faster."
    )
    inline_workers: Literal["processes", "threads"] = Field(
        "processes",
        description="With engine `inline`: whether each worker is a process (`processes`), or all workers are "
        "`threads` of one process. Threads need rollout `simd` and take less memory, but if one worker crashes, all "
        "are lost.",
    )
    address: Text | None = Field(
        None,
        description="With engine `ray`: address of the cluster to connect to, `HOST:PORT`, or `auto` for the cluster "
        "on this machine; `null` starts a Ray instance for this run.",
    )
    workers: Literal["auto"] | Count = Field(
        "auto",
        description="Number of workers, each of which is a core, or with GPUs its share of them. `auto`: every core "
        "of the machine or cluster that has work, or with the engine `inline` and GPUs as many as these have room "
        "for. With a number in `compute.worker_resources.cpu`, it also asks the cluster for up to 32 actors beyond "
        "its room, as far as there is work for them, so that an autoscaler starts nodes. No more start than there "
        "is work for in a generation, in whole actors; a note says so.",
    )
    platform: Literal["any", "x86_64", "aarch64"] = Field(
        "any",
        description="Architecture of the processors that work for the run, `x86_64` or `aarch64`; a worker on "
        "another one is refused, with a notice that names its host. `any`: all. What computed the run is recorded, "
        "and its digest is marked `mixed` once there are several kinds.",
    )
    max_workers_per_core: Count = Field(
        4,
        description="Most workers for each core where all workers are on this machine, with engine `inline` or with "
        "`ray` without an address; a larger number in `compute.workers` is refused. Raise it only for a task whose "
        "steps wait for something outside, such as another program.",
    )
    worker_resources: WorkerResources = Field(
        default_factory=lambda: WorkerResources(cpu="auto", gpu=0.0),
        description="Resources of one worker, which Ray reserves for its actor if the engine is ray.",
    )
    rollout: Text = Field(
        description="How episodes are computed. `simd`: by code compiled for this kind of processor or GPU, about "
        "twenty times faster. `xla`: by JAX, for tasks that simd cannot compile. `host`: by the Python code of a "
        "task that is not in JAX. `auto`: the fastest that can."
    )
    chunk_pairs: Count = Field(
        description="Pairs in one chunk; must divide `search.pairs`. `auto`: the largest divisor of `search.pairs` up "
        "to an eighth of it, and a multiple of 8 if there is one. This limit is at least 16 and at most 64; with "
        "GPUs it is 4,096."
    )
    rollout_block_pairs: Count = Field(
        description="With rollout `xla`: pairs whose episodes step together, so that their weights stay in the "
        "cache; must divide `compute.chunk_pairs`. `auto`: the largest divisor of `compute.chunk_pairs` up to 32 "
        "whose weights take at most 5 MiB; with GPUs as many as take 8 GiB."
    )
    gradient_block_pairs: Count = Field(
        description="Pairs summed into one partial gradient; at most `search.pairs`. `auto`: the smallest number of "
        "whole chunks that gives at most 32 blocks and makes each block large enough to be worth a message."
    )
    chunk_timeout_s: Positive = Field(
        30.0,
        description="Shortest deadline of a chunk in seconds; slow chunks make the deadline of later chunks longer, "
        "and each attempt may take twice as long as the one before. It counts anew whenever a worker reports "
        "progress: after each step of a task of Python objects, each call of a function, with `xla` each chunk of "
        "several that travel together. A worker that misses it is replaced.",
    )
    first_chunk_timeout_s: Positive = Field(
        120.0,
        description="Deadline in seconds of a chunk while it is not known how long chunks of its kind take, which is "
        "until the first one is done; at least `chunk_timeout_s`. Compilation does not count.",
    )
    compile_timeout_s: Positive = Field(
        120.0,
        description="Deadline in seconds for the compilation that a worker does before its first chunk of each kind; "
        "for a task of Python objects, longest time in which one of them must be made or reset. A message about a "
        "missed deadline says whether the worker was compiling or computing.",
    )
    max_attempts: Count = Field(4, description="Attempts to compute a chunk before the run stops with its error.")
    place_timeout_s: Positive | None = Field(
        None,
        description="With engine `ray` in a cluster: longest time in seconds for which the run waits for a first "
        "place, and for a process to start there, before it stops and asks for no more places. `null`: as long as "
        "it takes. `status` says that the run waits. The wait is no part of `budget.wall_clock_s`.",
    )
    no_worker_timeout_s: Patience = Field(
        120.0,
        description="Seconds without a live worker, after the first had come up, after which the run stops, with "
        "everything saved; at least 20. A worker that has not started after half of this time is replaced; on a "
        "busy machine a start takes up to ten seconds.",
    )
    parent_cache_mb: Count = Field(
        256,
        description="Most MiB of parameters that each worker remembers, so that they are sent to it once: of elites "
        "from which it makes policies, and of centres. What its newest work item needs is remembered in any case. It "
        "never changes results.",
    )
    worker_memory_mb: Count | None = Field(
        None,
        description="MiB of memory, its simulators included, above which a worker is replaced by a new process once "
        "it has computed what it was sent; an actor with several cores has as much for each. `null`: no limit. It "
        "changes no result.",
    )
    worker_output_bytes: Count = Field(
        2**20,
        description="About how many bytes are kept of what each worker prints, its simulators and the processes that "
        "they start included: the newest, on the worker's disk. The last lines are told if the worker is lost; with "
        "engine `ray`, all are in Ray's log files of this worker, on its node.",
    )
    dispatch_log: Switch = Field(
        False,
        description="Whether the run folder gets a `dispatch.jsonl`: what was sent to each worker, what it answered, "
        "and why it was lost.",
    )
