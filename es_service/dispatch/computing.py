"""The time in which workers compute: without their starting and compiling, and waits for them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

from es_service.dispatch import events
from es_service.dispatch.scheduler_state import SchedulerState, pending


@dataclass
class Computing:
    """Adds up the time in which there is work, and a worker that has compiled for it.

    It begins with a phase if a worker has computed chunks of such a kind before, or else when a first one has compiled
    for one; it ends with the last result, or when no worker is left.
    """

    _total_s: float = 0.0
    _since_s: float | None = None
    _kinds: Collection[str] = ()
    """Of the chunks of the phase."""
    _compiled: set[str] = field(default_factory=set)
    """Kinds for which a worker that is left may have compiled."""

    def begin(self, kinds: Collection[str], now: float) -> None:
        """Note that a phase begins."""
        self._kinds = kinds
        if not self._compiled.isdisjoint(kinds):
            self._since_s = now

    def note(self, event: events.Event, state: SchedulerState, now: float) -> None:
        """Note an event that the scheduler has handled; `state` is the one after it."""
        if isinstance(event, events.Compiled):
            self._compiled.add(event.kind)
            if self._since_s is None and event.kind in self._kinds and pending(state):
                self._since_s = now
        elif isinstance(event, events.WorkerLost) and not state.up and not state.draining:
            self._compiled.clear()
            self._end(now)
        if self._since_s is not None and not pending(state) and not isinstance(event, events.Submit):
            self._end(now)

    def _end(self, now: float) -> None:
        self._total_s = self.seconds(now)
        self._since_s = None

    def seconds(self, now: float) -> float:
        """The time until now."""
        return self._total_s + (0.0 if self._since_s is None else now - self._since_s)
