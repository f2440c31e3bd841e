"""What the loop works with: the definition of a run, the store in which it is kept, a request to stop, and everything
that a run carries from one generation to the next, with the statistics of observations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from es_service.config.model import RunConfig
from es_service.config.workload import policy_spec
from es_service.errors import ConfigError
from es_service.loop.history import HistoryRow, Table
from es_service.protocol.content import NAME, Arrays, Contents
from es_service.protocol.messages import FloatArray, Moments, TaskSpec
from es_service.protocol.policy_spec import PolicySpec
from es_service.search.algorithms.base import Algorithm, CentreState, SearchState

Changes = Mapping[str, Arrays | None]
"""Blocks that a generation has changed, by name; None for those that it has removed."""

# Running statistics of observations, merged by the driver in chunk order and in float64. Axis O: observation.

STD_FLOOR = 0.1
"""Least standard deviation for normalisation. Source: released code of the ES papers, sqrt(max(var, 0.01))."""


def no_observations(size: int) -> Moments:
    """Statistics of no observations of this size, as before the first generation."""
    return Moments(0.0, np.zeros(size), np.zeros(size))


def moments_of(values_N_O: NDArray[Any]) -> Moments:
    """Moments of N values along the first axis, computed in float64; they may have other axes, or none."""
    mean_O = values_N_O.mean(axis=0, dtype=np.float64)
    return Moments(float(len(values_N_O)), mean_O, np.square(values_N_O - mean_O).sum(axis=0, dtype=np.float64))


def merge_moments(total: Moments, parts: Iterable[Moments]) -> Moments:
    """Merge `parts` into `total` one after another, in the order given, which affects the last bits of the result.

    Source: pairwise update of Chan, Golub and LeVeque 1983.
    """
    for part in parts:
        if part.count == 0.0:
            continue
        count = total.count + part.count
        delta_O = part.mean_O - total.mean_O
        total = Moments(
            count,
            total.mean_O + delta_O * (part.count / count),
            total.m2_O + part.m2_O + np.square(delta_O) * (total.count * part.count / count),
        )
    return total


def normalisation(moments: Moments, enabled: bool) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviation (population formula) that normalise observations, float32 [O] each.

    They are 0 and 1 if normalisation is off or if nothing has been counted. The standard deviation is at least
    STD_FLOOR.
    """
    if not enabled or moments.count == 0.0:
        size = moments.mean_O.shape[0]
        return np.zeros(size, np.float32), np.ones(size, np.float32)
    std_O = np.sqrt(np.maximum(moments.m2_O / moments.count, STD_FLOOR**2))
    return moments.mean_O.astype(np.float32), std_O.astype(np.float32)


@dataclass(frozen=True)
class Best:
    """The centre with the highest mean fitness so far, with the observation statistics of its evaluation."""

    generation: int
    fitness: float
    policy: NDArray[Any]
    """Its name."""


NO_BEST = Best(0, -math.inf, np.zeros((), NAME))
"""Before the first generation."""


@dataclass(frozen=True)
class RunState:
    """State of a run after `generation` generations."""

    generation: int
    search: SearchState
    observations: Moments
    best: Best
    env_steps: int
    """Environment steps so far, evaluations included; a Python int, since it can exceed 32 bits."""
    episodes: int
    wall_clock_s: float
    """Seconds spent so far in all sessions. They are stored only in the history, because they are not deterministic."""
    rollout_s: float = 0.0
    cpu_s: float = 0.0
    """The columns of the history of these names; NaN if they are not known. They are stored only there."""
    durations: tuple[float, ...] = ()
    """`budget.durations` of the newest generations."""


def statistics_in_force(
    observations: Moments, centre: CentreState | None, enabled: bool
) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviation with which a centre's episodes normalise observations, float32 [O] each.

    They are the centre's own if it has any, else those of the whole run; 0 and 1 if observations are not normalised.
    """
    if enabled and centre is not None and centre.own_mean_O is not None and centre.own_std_O is not None:
        return centre.own_mean_O, centre.own_std_O
    return normalisation(observations, enabled)


class Stored(Protocol):
    """What the loop reads from a run store: the state that earlier sessions have stored."""

    @property
    def generation(self) -> int | None:
        """Newest committed generation; None before the first."""
        ...

    def load(self) -> Mapping[str, Arrays]: ...
    def newest_history(self, count: int) -> Sequence[Mapping[str, Any]]: ...


class Generation(NamedTuple):
    """What is stored of a generation."""

    number: int
    parts: Changes
    """Parts of the state that it has changed, None for those that it has removed; the others keep their values."""
    history: HistoryRow
    """Value of each column of the run; `generation` may be left out; NaN or None stands for no value."""
    evaluations: Table = MappingProxyType({})
    """Likewise for the centres that it has evaluated, in the order of the asks."""
    contents: Contents = MappingProxyType({})
    """Policies and traces by name, among them those that the parts name and that no generation before named."""
    recorded: Mapping[str, float] = MappingProxyType({})
    """Metrics that a caller has told, by name; they are no columns."""


class Store(Protocol):
    """What the loop needs from a run store during a run."""

    def content(self, name: bytes) -> Arrays:
        """A policy or a trace that a stored state names. Raises KeyError if there is none of this name."""
        ...

    def commit(self, generations: Sequence[Generation]) -> None:
        """Take generations that follow one another, all or none."""
        ...


@dataclass(frozen=True)
class Stop:
    """A request to end a session, returned by the function that is called with each committed history row."""

    reason: str
    """Why the session ends, in words."""
    metrics: Mapping[str, Any] = field(default_factory=dict)
    """Numbers to be recorded of this generation, by name; as if they had been returned alone."""

    def __post_init__(self) -> None:
        """Raises ConfigError if there are no words, since every reader of the run shows them."""
        if not isinstance(self.reason, str) or not self.reason.strip():
            raise ConfigError(
                f"Stop({self.reason!r}): the reason must be words that say why the session ends",
                field="reason",
                value=self.reason,
                allowed="words",
            )


@dataclass(frozen=True)
class Observer:
    """A function that only looks at history rows, so that generations may be committed together before it is called
    with the row of each. It cannot end a session and records nothing."""

    function: Callable[[Mapping[str, Any]], object]

    def __call__(self, row: Mapping[str, Any]) -> None:
        """Show a row. Raises ConfigError if the function returns a `Stop`."""
        if isinstance(self.function(row), Stop):
            raise ConfigError(
                "on_generation: the function of an Observer has returned a Stop; give the function itself, so that the "
                "run can end with the generation that it was called with",
                field="on_generation",
                allowed="a function",
            )


@dataclass(frozen=True)
class Search:
    """Definition of a run apart from where it runs: config, algorithm, starting point and task."""

    config: RunConfig
    algorithm: Algorithm
    initial: Callable[[], tuple[Sequence[FloatArray], Moments]]
    """Returns the initial centres [D] and their observation statistics, which are empty unless the centres are from
    another run."""
    task: TaskSpec
    statistics: Callable[[], Sequence[tuple[FloatArray, FloatArray]]] = lambda: ()
    """Returns mean and standard deviation of observations, [O] each, that each initial centre keeps as its own; none if
    they all use those of the whole run."""

    @cached_property
    def spec(self) -> PolicySpec:
        return policy_spec(self.config, self.task)
