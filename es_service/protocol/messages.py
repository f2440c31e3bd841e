"""What the driver and the workers say to each other: NumPy only, picklable, every array named by its axes.

A leaf of the import graph: both sides import it and it imports neither. Axes: D policy parameters, P antithetic pairs
of one chunk, S sign [+, -], E episodes of one evaluation chunk, O observation, B descriptor dimensions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float32]
Bounds = tuple[tuple[float, float], ...]
Segment = tuple[tuple[float, float], tuple[float, float]]
SIGNS = (1.0, -1.0)
"""The two members of a pair, in the order of axis S."""
TRACE_POINTS = 64
"""Of an evaluation's trace; fewer if the episode has fewer steps."""
EVALUATION_EPISODES_PER_CHUNK = 16
"""Episodes in one evaluation chunk; a constant, so that its compiled shape is one too."""


@dataclass(frozen=True)
class TaskSpec:
    """What the driver must know about a task before any worker starts; plain data, kept with every run."""

    name: str
    observation_size: int
    action_size: int
    episode_steps: int
    """Default length of an episode in control steps."""
    descriptor_names: tuple[str, ...]
    descriptor_bounds: Bounds
    """(low, high) per descriptor dimension, in the units of the task."""
    final_fitness: bool
    """Whether `task.fitness: final` (the reward of the last valid step) makes sense here."""
    has_goal: bool
    """Whether there is a place to reach, so that distances to it are kept in the history."""
    options: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Task options a config may set, each with its allowed values; the first is the default."""
    summary: str = ""
    descriptors: dict[str, tuple[tuple[str, ...], Bounds]] = field(default_factory=dict)
    """Where the task's option `descriptor` chooses: name -> (descriptor_names, descriptor_bounds)."""
    walls: tuple[Segment, ...] | None = None
    """Where the descriptor is a place in the plane: all walls there, so that it is known which places can be reached;
    None where it is not specified."""
    wall_clearance: float = 0.0
    """How near the middle of a wall no descriptor can come."""
    least_reward: float | None = None
    """What a QD-score counts from, per step: about the least mean reward of an episode. Not always a bound: short
    episodes of AntTrap can be below. None where it is not specified."""
    no_simd: str = ""
    """Why simd cannot compile its episodes; empty where it can."""


def with_options(task: TaskSpec, options: Mapping[str, str]) -> TaskSpec:
    """The task as these options make it: with the descriptor they choose."""
    chosen = options.get("descriptor")
    if chosen not in task.descriptors:
        return task
    names, bounds = task.descriptors[chosen]
    return replace(task, descriptor_names=names, descriptor_bounds=bounds)


@dataclass(frozen=True)
class PolicyShape:
    """Layer widths from observation to action; the flat vector holds, layer by layer, weights [in, out] then biases."""

    widths: tuple[int, ...]

    @property
    def layers(self) -> tuple[tuple[int, int], ...]:
        """(inputs, outputs) of every layer."""
        return tuple(zip(self.widths[:-1], self.widths[1:], strict=True))

    @property
    def parameters(self) -> int:
        """D, the length of the flat vector."""
        return sum(inputs * outputs + outputs for inputs, outputs in self.layers)


@dataclass(frozen=True)
class WorkerSpec:
    """Everything a worker must know, sent once when it starts: constants of the run."""

    seed: int
    environment: str
    environment_options: dict[str, str]
    policy: PolicyShape
    episode_steps: int
    fitness: Literal["sum", "final"]
    episodes_per_member: int
    observation_clip: float | None
    action_noise: float
    common_random_numbers: bool
    chunk_pairs: int
    """Pairs in a training chunk: its compiled shape."""
    rollout_block_pairs: int
    """With xla, pairs that step together inside a chunk; divides `chunk_pairs`. Few enough for their weights to stay in
    cache."""
    gradient_block_pairs: int
    """Pairs whose weighted noise is summed into one partial gradient."""
    rollout: Literal["xla", "simd"] = "xla"
    """What computes episodes and gradients."""


class WorkerPlace(NamedTuple):
    """Where a worker lives."""

    host: str
    pid: int
    node: str
    """Id of the node in its cluster."""

    def __str__(self) -> str:
        return f"{self.host} (pid {self.pid})"


@dataclass(frozen=True)
class Centre:
    """The point all chunks of one phase share: policy parameters, noise width, observation statistics."""

    generation: int
    parameters_D: FloatArray
    sigma: float
    """Standard deviation of the parameter noise, in parameter units."""
    observation_mean_O: FloatArray
    observation_std_O: FloatArray
    """Statistics as they were at the start of the generation, or those that the member keeps from the elite it began
    with; 0 and 1 where normalisation is off."""


@dataclass(frozen=True)
class TrainingChunk:
    """Roll out pairs `chunk_id * chunk_pairs ...` around the centre, both signs, with action noise."""

    generation: int
    chunk_id: int


@dataclass(frozen=True)
class EvaluationChunk:
    """Roll out 16 episodes of the unperturbed centre without action noise; episode ids start at 16 * chunk_id."""

    generation: int
    chunk_id: int


@dataclass(frozen=True)
class GradientChunk:
    """Sum weight * noise over one fixed block of pairs, starting at pair `chunk_id * gradient_block_pairs`."""

    generation: int
    chunk_id: int
    weights_P: FloatArray
    """Utility of + minus utility of -, per pair of the block; pairs past the end of the population weigh 0."""


Chunk = TrainingChunk | EvaluationChunk | GradientChunk


class WorkItemId(NamedTuple):
    """Which work item: what engines and workers call the chunks that travel together."""

    phase: int
    """Number of the `evaluate` call, so that a late answer of an earlier call is never taken for one of this call."""
    kind: str
    generation: int
    chunk_id: int
    """Of the first."""
    chunks: int

    def __str__(self) -> str:
        others = f" and {self.chunks - 1} more" if self.chunks > 1 else ""
        return f"{self.kind} {self.chunk_id}{others} of generation {self.generation}"


@dataclass(frozen=True)
class Moments:
    """Count, mean and sum of squared deviations of observations, in float64; mergeable."""

    count: float
    mean_O: NDArray[np.float64]
    m2_O: NDArray[np.float64]


@dataclass(frozen=True)
class EpisodesResult:
    """What came of a training chunk (leading axes P, S) or an evaluation chunk (leading axis E)."""

    fitness: FloatArray
    """Mean over the member's episodes of its return, or of its last reward with `fitness: final`."""
    returns: FloatArray
    """Mean over the member's episodes of the sum of rewards; equals `fitness` with `fitness: sum`."""
    descriptor: FloatArray
    """Leading axes + B: mean over the member's episodes, each copied at the end of its episode."""
    steps: NDArray[np.int32]
    """Environment steps taken before or at `done`, summed over the member's episodes."""
    goal_distance: FloatArray
    """Leading axes + 2: distance to the goal at the end of the episode, and its minimum; NaN without a goal."""
    moments: Moments | None
    """Of every observation acted on before `done`; None for evaluations, which feed no statistics."""
    trace_T_B: FloatArray | None = None
    """Of an evaluation: the descriptor along its first episode, from the reset to the end in equal steps."""


@dataclass(frozen=True)
class GradientResult:
    """One partial sum of the gradient estimate, in units of weight x standard normal noise."""

    sum_D: FloatArray


ChunkResult = EpisodesResult | GradientResult


@dataclass(frozen=True)
class DispatchCounts:
    """Faults survived so far by an evaluator, over all generations of this process."""

    retries: int = 0
    """Chunks handed out again, also those that a lost worker had not begun."""
    lost_workers: int = 0
    workers: int = 0
    """Workers the evaluator was asked to keep."""


class Evaluator(Protocol):
    """Runs chunks somewhere. The driver neither knows nor cares where, in what order, or how often."""

    @property
    def counts(self) -> DispatchCounts:
        """Faults so far."""
        ...

    def evaluate(self, centre: Centre, chunks: Sequence[Chunk]) -> list[ChunkResult]:
        """Results in the order of `chunks`. Raises EvaluationError, or Interrupted when asked to stop."""
        ...
