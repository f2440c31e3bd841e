"""Messages between the driver and the workers: picklable, with NumPy arrays whose names end in their axes.

Axes: D policy parameters, P antithetic pairs of one chunk, S sign [+, -], E episodes of one evaluation chunk, L slots
of one policy chunk, O observation, B descriptor dimensions, T points of a trace. Both sides import this module and it
imports neither.

The result of a chunk depends only on the config, the seed, the generation, the ask, the chunk id, the centre and the
observation statistics: not on the worker, on the order, or on how often the chunk is computed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.nearest import ArchiveEntries
from es_service.protocol.options import Option, OptionValue, ParameterSpec
from es_service.protocol.policies import FloatArray, Policies, PolicyChunk, Recipes
from es_service.protocol.policy_spec import PolicySpec
from es_service.protocol.sources import task_code

Bounds = tuple[tuple[float, float], ...]
Segment = tuple[tuple[float, float], tuple[float, float]]
TaskKind = Literal["jax", "python", "function", "caller"]
"""What a task is made of: functions that JAX traces; Python objects with `reset` and `step`; one function of its
parameters, without a policy; or nothing, because whoever asks the search computes the episodes."""
DescriptorChoice = str | tuple[int, ...]
"""Descriptor that a config chooses for a task of Python objects: a key of `info`, `module:function`, or the indices of
numbers of the last observation."""
UNBOUNDED = (-1e30, 1e30)
"""Bounds of a dimension of a descriptor that has none."""
SIGNS = (1.0, -1.0)
"""Signs of the noise of the two members of a pair, in the order of axis S."""
TRACE_POINTS = 64
"""Most points T in the trace of an evaluation; a trace has fewer if the episode has fewer steps."""
EVALUATION_EPISODES_PER_CHUNK = 16
"""Episodes in one evaluation chunk. This is a constant so that the shape that is compiled never changes."""


@dataclass(frozen=True)
class TaskSpec:
    """Description of a task, which the driver needs before any worker starts; plain data, stored with every run."""

    name: str
    observation_size: int
    action_size: int
    episode_steps: int
    """Default length of an episode in control steps."""
    descriptor_names: tuple[str, ...]
    descriptor_bounds: Bounds
    """(low, high) of each descriptor dimension, in the units of the task."""
    final_fitness: bool
    """Whether the task allows `task.fitness: final` (the reward of the last valid step)."""
    has_goal: bool
    """Whether the task has a goal; if it has, the history has columns for the distance to the goal."""
    options: dict[str, Option] = field(default_factory=dict)
    """Options of the task that a config can set, by name."""
    summary: str = ""
    """One line about the task, which `es-service list` shows."""
    descriptors: dict[str, tuple[tuple[str, ...], Bounds]] = field(default_factory=dict)
    """Descriptors among which the task's option `descriptor` chooses: name -> (descriptor_names, descriptor_bounds).
    Empty if the task has no such option."""
    walls: tuple[Segment, ...] | None = None
    """All walls, as segments, if the descriptor is a position in the plane; they determine which cells of a map can be
    reached. None if they are not specified."""
    wall_clearance: float = 0.0
    """Least distance between a descriptor and the middle line of a wall."""
    goal: tuple[float, float] | None = None
    """Place of the goal, if the descriptor is a position in the plane; shown in reports. None if there is none."""
    goals: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """Values of the option `goal` with which every episode has the same goal -> the descriptor of an episode that ends
    there."""
    goal_radius: float = 0.0
    """Distance from such a goal within which an episode has reached it."""
    least_reward: float | None = None
    """Reward per step from which a QD-score counts: about the least mean reward of an episode. It is not always a
    lower bound: short episodes of AntTrap can be below it. None if it is not specified."""
    success: str = ""
    """Which episodes succeed, in words; empty if the task does not say."""
    unsupported: dict[str, str] = field(default_factory=dict)
    """Rollouts that were found to be unable to compute episodes of this task, by name, each with the reason."""
    hidden: dict[str, str] = field(default_factory=dict)
    """Rollouts that compute a number where the task as JAX defines it was found not to be finite, by name, each with
    the sentence that says where."""
    kind: TaskKind = "jax"
    """What the task is made of, on which it depends which rollouts can compute it."""
    discrete_actions: bool = False
    """Whether an action is a choice of one of `action_size` actions, so that the policy has to choose one."""
    ranked_actions: bool = False
    """Whether an action has a number for each choice, of which the task takes the greatest that it allows, so that
    `argmax` and `categorical` give it the numbers by which they would choose."""
    action_bounds: Bounds = ()
    """What the actions -1 and 1 of a policy become, (low, high) for each number of an action; empty if they stay -1 and
    1."""
    parameters: ParameterSpec | None = None
    """Parameters of a function that is the task; None for all other tasks."""
    deterministic: bool = False
    """Whether the task declares that equal parameters have equal results."""
    does_not_repeat: str = ""
    """Where a task of Python objects was found to return other numbers for the same seed and actions, in words, such as
    `after another episode`; empty if it was not found to, or was not tried."""
    notes: tuple[str, ...] = ()
    """What its author probably did not intend, such as an attribute with an unknown name, in sentences."""
    metric_names: tuple[str, ...] = ()
    """Numbers that it records of each episode besides what every task has; see `episodes.METRICS`."""


@dataclass(frozen=True)
class HostChoices:
    """What a config chooses for a task of Python objects besides its options, by keys of `task`."""

    descriptor: DescriptorChoice | None = None
    """None: the descriptor of the task."""
    success: str | None = None
    """Key of the last `info` that says whether an episode has succeeded; None: as the task says."""
    new_objects: bool = False
    """Whether each episode has an object of its own."""
    metrics: tuple[str, ...] = ()
    """Keys of `info` that are metrics, each as KEY or KEY:TAKEN; see `episodes.CHOSEN_METRIC`."""


NO_CHOICES = HostChoices()


def with_options(task: TaskSpec, options: Mapping[str, OptionValue]) -> TaskSpec:
    """The task with the descriptor and the goal that its options `descriptor` and `goal` choose."""
    chosen, goal = options.get("descriptor"), options.get("goal")
    if isinstance(chosen, str) and chosen in task.descriptors:
        names, bounds = task.descriptors[chosen]
        task = replace(task, descriptor_names=names, descriptor_bounds=bounds)
    place = task.goals.get(goal, ()) if isinstance(goal, str) else ()
    return replace(task, goal=(place[0], place[1])) if len(place) == 2 else task


@dataclass(frozen=True)
class WorkerSpec:
    """Constants of the run that a worker needs; sent to it once, when it starts."""

    seed: int
    environment: str
    environment_options: dict[str, OptionValue]
    policy: PolicySpec
    episode_steps: int
    fitness: Literal["sum", "final"]
    episodes_per_member: int
    observation_clip: float | None
    action_noise: float
    common_random_numbers: bool
    chunk_pairs: int
    """Pairs in a training chunk; functions are compiled for this shape."""
    rollout_block_pairs: int
    """With xla, pairs that step together inside a chunk; a divisor of `chunk_pairs`. It is small so that their weights
    stay in the processor's cache."""
    gradient_block_pairs: int
    """Pairs whose weighted noise is summed into one partial gradient."""
    rollout: str
    """What computes episodes and gradients: a name in `workers.rollouts.BACKENDS`."""
    noise_rank: int = 0
    """Rank of the noise of each weight matrix, as in `policy_spec.py`; 0: each parameter has a number of its own."""
    choices: HostChoices = NO_CHOICES
    """What the config chooses for a task of Python objects."""
    allow_infeasible: bool = False
    """Whether a fitness of -inf says that a point is infeasible, which is no failure."""
    time_limit_s: float | None = None
    """Longest time of a call of a function, if the task is one; None: it has none."""
    descriptor_size: int = 0
    """How many numbers the descriptor has that the config chooses; 0 if it is the task's."""
    outputs: tuple[str, ...] = ()
    """Outputs of episodes besides those of every result; names of `protocol.episodes`."""
    keyed_resets: bool = False
    """Whether environments of Gymnasium draw the starts of policies' episodes with the noise of the reset keys, so that
    they are those of a task in JAX; no run does so."""
    parent_cache_bytes: int = 2**28
    """Most bytes of arrays that the worker remembers, beyond what one work item needs; see `sent.Memory`."""
    recycle_after_episodes: int | None = None
    """Episodes after which each core of a worker should be a new process; None: any number."""
    memory_bytes: int | None = None
    """Memory, for each core, above which a worker should be replaced by a new process; None: any amount."""
    output_bytes: int = 2**20
    """Most bytes that are kept of what its process prints; see `process_environment.py`."""
    sources: dict[str, str] = field(default_factory=dict)
    """`sources.worker_sources` of the driver, which a worker must have as well; empty if this is not checked."""
    platform: str = "any"
    """Architecture that a worker must have, as `system.architecture` names it; any if it makes no difference."""

    @property
    def task_code(self) -> tuple[str, ...]:
        """`sources.task_code` of its task."""
        return task_code(self.environment, self.choices.descriptor, self.environment_options)


class Report(NamedTuple):
    """What a worker tells besides results."""

    printed: str
    """The newest lines that its process and others that it started have printed since the last report."""
    spent: str
    """Why it should be replaced by a new process, as a clause about it; empty if it should not."""


class WorkerPlace(NamedTuple):
    """Host and process of a worker."""

    host: str
    pid: int
    node: str
    """Ray's id of the cluster node."""
    logs: tuple[str, ...] = ()
    """Files there with what it prints."""

    def __str__(self) -> str:
        return f"{self.host} (pid {self.pid})"


@dataclass(frozen=True)
class Centre:
    """Centre of a search distribution, with the standard deviation of its noise and the observation statistics."""

    generation: int
    parameters_D: FloatArray
    sigma: float
    """Standard deviation of the parameter noise, in parameter units."""
    observation_mean_O: FloatArray
    observation_std_O: FloatArray
    """Statistics at the start of the generation, or those of the elite with which the block started; 0 and 1 if
    normalisation is off."""
    archive: ArchiveEntries | None = None
    """The novelty archive before the generation, if workers compute the novelty of the members."""


_NOTHING = np.zeros(0, np.float32)
NO_CENTRE = Centre(0, _NOTHING, 0.0, _NOTHING, _NOTHING)
"""Stands for the centre of chunks that need none."""


@dataclass(frozen=True)
class TrainingChunk:
    """Request to roll out `chunk_pairs` pairs around the centre with action noise, from pair `chunk_id * chunk_pairs`
    on."""

    generation: int
    chunk_id: int
    ask: int = 0
    """Index of the population in its generation. Every population has random streams of its own."""
    request: int = 0
    """Whose rows its results are: the index of what is asked for, among all that is computed side by side."""


@dataclass(frozen=True)
class EvaluationChunk:
    """Request to roll out episodes of the centre itself without action noise, from episode `16 * chunk_id` on."""

    generation: int
    chunk_id: int
    ask: int = 0
    """As for training. Each centre that is evaluated in a generation has resets of its own."""
    episodes: int = EVALUATION_EPISODES_PER_CHUNK
    """Number of episodes that are wanted among the chunk's 16. The shape that is compiled has all of them."""
    first: int = 0
    """The first of them, if this is a piece of a chunk (`protocol.episodes`)."""
    request: int = 0
    """As for training."""


@dataclass(frozen=True)
class GradientChunk:
    """Request to sum weight * noise over one block of pairs, from pair `chunk_id * gradient_block_pairs` on."""

    generation: int
    chunk_id: int
    weights_P: FloatArray
    """Utility of the + member minus utility of the - member, for each pair of the block; 0 for pairs beyond the end of
    the population."""
    ask: int = 0
    """As for training."""


def evaluation_chunks(
    generation: int, episodes: int, *, first: int = 0, ask: int = 0, request: int = 0
) -> list[EvaluationChunk]:
    """The chunks of a centre's evaluation, with ids from `first` on."""
    size = EVALUATION_EPISODES_PER_CHUNK
    return [
        EvaluationChunk(generation, first + i, ask, min(size, episodes - start), request=request)
        for i, start in enumerate(range(0, episodes, size))
    ]


Chunk = TrainingChunk | EvaluationChunk | GradientChunk | PolicyChunk
Subject = Centre | Policies
"""What the episodes of a chunk run: the centre of training, evaluation and gradient chunks, or policies."""
Work = tuple[Subject, Chunk]
"""A chunk with the subject that it belongs to."""
FAILURES_TOLD = 16
"""Most failed episodes that the result of a chunk names."""


def recipes_in(subject: Subject) -> Recipes | None:
    """The recipes by which a subject's policies are made; None for others, whose parameters travel."""
    given = subject.parameters_N_D if isinstance(subject, Policies) else None
    return given if isinstance(given, Recipes) else None


def with_subject(subject: Subject, chunks: Iterable[Chunk]) -> list[Work]:
    return [(subject, chunk) for chunk in chunks]


def chunk_name(chunk: Chunk) -> str:
    """Name of a chunk in messages, such as `TrainingChunk 3 of generation 5`."""
    population = f" of population {chunk.ask}" if chunk.ask else ""
    return f"{type(chunk).__name__} {chunk.chunk_id}{population} of generation {chunk.generation}"


class WorkItemId(NamedTuple):
    """Identity of a work item, that is, of chunks that are sent to a worker together."""

    phase: int
    """Number of the `evaluate` call. It distinguishes a late answer to an earlier call from an answer to this call."""
    first: int
    """Index of the first chunk in the call. Chunks of several centres may have the same generation, ask and id."""
    kind: str
    """Class name of the chunks."""
    generation: int
    ask: int
    """Population of the first chunk."""
    chunk_id: int
    """Id of the first chunk in its population."""
    chunks: int
    """Number of chunks, which may belong to several populations."""

    def __str__(self) -> str:
        population = f" of population {self.ask}" if self.ask else ""
        others = f" and {self.chunks - 1} more" if self.chunks > 1 else ""
        return f"{self.kind} {self.chunk_id}{population}{others} of generation {self.generation}"


@dataclass(frozen=True)
class Moments:
    """Count, mean and sum of squared deviations of observations in float64, which can be merged."""

    count: float
    mean_O: NDArray[np.float64]
    m2_O: NDArray[np.float64]
    """Sum of squared deviations from the mean."""


@dataclass(frozen=True)
class MomentsOfChunks:
    """Moments of several chunks C, as arrays."""

    count_C: NDArray[np.float64]
    mean_C_O: NDArray[np.float64]
    m2_C_O: NDArray[np.float64]

    @classmethod
    def of(cls, moments: Sequence[Moments]) -> MomentsOfChunks:
        """Those of chunks, in their order."""
        count_C = np.array([of_chunk.count for of_chunk in moments])
        return cls(
            count_C,
            np.stack([of_chunk.mean_O for of_chunk in moments]),
            np.stack([of_chunk.m2_O for of_chunk in moments]),
        )

    def each(self) -> list[Moments]:
        """Those of each chunk, in the order of the chunks."""
        return [Moments(*of_chunk) for of_chunk in zip(self.count_C.tolist(), self.mean_C_O, self.m2_C_O, strict=True)]


@dataclass(frozen=True)
class EpisodesResult:
    """Result of a training chunk, an evaluation chunk or a policy chunk: rows of a request. `episodes.in_blocks` makes
    one of neighbouring chunks, and `episodes.gathered` of all rows of a request.

    A training chunk's arrays have leading axes [P, S] and are over the member's episodes. The arrays of other chunks
    are of single episodes: [E] of the centre, or [L] of the policies in a chunk's slots.
    """

    fitness: FloatArray
    """Mean return, or with `fitness: final` mean reward of the last step."""
    returns: FloatArray
    """Mean return (sum of rewards); equals `fitness` with `fitness: sum`."""
    descriptor: FloatArray
    """[..., B]: mean of the descriptors at the ends of the episodes."""
    steps: NDArray[np.int32]
    """Number of environment steps up to and including `done`, summed over the member's episodes."""
    goal_distance: FloatArray
    """[..., 2]: mean distance to the goal at the end of the episodes, and least distance in any of them; NaN if the
    task has no goal."""
    moments: Moments | MomentsOfChunks | None
    """Moments of all observations that the policy acted on in valid episodes; None for evaluations, which do not update
    the observation statistics."""
    trace_T_B: FloatArray | None = None
    """Descriptor along the first episode of an evaluation chunk, at equal time intervals from the reset to the last
    possible step; None for training. For policies [..., T, B]: of each slot with a first episode, or None."""
    outputs: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """Outputs that `WorkerSpec.outputs` names, by name, with the leading axes of the other arrays.

    success: bool, whether the episode succeeded as the task declares it; metrics [..., M]: those that the task
    records, in the order of `TaskSpec.metric_names`, float32; last_reward: reward of the last valid step;
    last_observation [..., O]: observation after it; first_observation [..., O]: that of the reset. A member has the
    mean of its episodes, float32. Not named there: `nearest.NOVELTY`."""
    of_steps: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """Outputs of each step that it names, [K, ...]: the valid steps of all episodes, one episode after another in the
    order of the other arrays, with as many rows as `steps` says of each.

    observation [K, O]: what the policy sees, neither normalised nor clipped; action [K, A]: what the task gets, with
    its noise; reward, done: those of the step, float32 and bool; step_descriptor [K, B]: descriptor after it."""
    failures: tuple[str, ...] = ()
    """Invalid episodes of which the rollout knows why they are invalid, each as a text that names the member, its seed,
    its parameters and the reason; at most FAILURES_TOLD of a chunk."""
    request: int = 0
    """As in the chunk."""
    row_N: NDArray[np.intp] | None = None
    """Numbers of these rows among those of the request, whose first need not be 0: of pairs, of the centre's episodes,
    or of policies' episodes, all of the first policy, all of the second, ... None: they are all of them."""


@dataclass(frozen=True)
class GradientResult:
    """One partial sum of the gradient estimate."""

    sum_D: FloatArray | None
    """Sum over the pairs of the blocks of weight x standard normal noise; None if an earlier result contains it."""
    blocks: int = 1
    """Number of blocks in the sum, from its chunk's block on: a node of the tree of `protocol.gradient_tree`."""


ChunkResult = EpisodesResult | GradientResult
