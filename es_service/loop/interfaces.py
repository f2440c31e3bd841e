"""What the loop needs of the rest: a run's search, the store in which it is kept, and a request to stop."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from es_service.config.model import RunConfig
from es_service.errors import ConfigError
from es_service.loop.blocks import Changes
from es_service.loop.history import HistoryRow, Table
from es_service.protocol.content import Arrays, Contents
from es_service.protocol.messages import FloatArray, Moments, TaskSpec
from es_service.search.algorithms.base import Algorithm


class Stored(Protocol):
    """What the loop reads from a run store: the state that earlier sessions have stored."""

    @property
    def generation(self) -> int | None:
        """Newest committed generation; None before the first."""
        ...

    def load(self) -> Mapping[str, Arrays]: ...
    def newest_history(self, count: int) -> Sequence[Mapping[str, Any]]: ...


class Store(Protocol):
    """What the loop needs from a run store during a run."""

    def content(self, name: bytes) -> Arrays:
        """A policy or a trace that a stored state names. Raises KeyError if there is none of this name."""
        ...

    def commit(
        self, generation: int, parts: Changes, history: HistoryRow, evaluations: Table, contents: Contents
    ) -> None:
        """Take a generation, with the policies and traces that it names and no generation before."""
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
