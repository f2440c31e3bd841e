"""What work waits for when nothing is heard of it: a first place in a cluster, workers that start and compile, or
simulators that make and reset environments; and the time in which workers compute."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field

from es_service.dispatch import events
from es_service.dispatch.events import Progress
from es_service.dispatch.scheduler_state import SchedulerState, is_waiting, pending

NOTICE_S = 5.0
"""Seconds without a first place after which a run is said to wait. A cluster with room takes less to start a process.
"""
SILENCE_S = 2.0
"""Seconds of a phase after which workers are said to compile for it, or to make or reset environments."""
AGAIN_S = 5.0
"""Least time in seconds between two texts on how far these environments are."""


class Waits:
    """Tells of waits as they begin and end."""

    def __init__(self, on_wait: Callable[[str], None], on_compile: Callable[[str, str], None]) -> None:
        """Tell of nothing yet.

        Args:
            on_wait: called with `Transport.shortage` when work has waited for a first place for NOTICE_S seconds, and
                with "" when that wait is over.
            on_compile: called when SILENCE_S seconds of a phase have passed and something changes, with a kind of
                chunks if the first workers start or compile for it, or "" if none does; and with a text on environments
                that are made or reset, such as "making 16 environments: 4 of 16", or "".
        """
        self._on_wait, self._waits = on_wait, False
        self._on_compile, self._told, self._text_s = on_compile, ("", ""), -math.inf
        self._kinds: tuple[str, ...] = ()
        self._begun_s = math.inf

    def begin(self, kinds: Iterable[str], now: float) -> None:
        self._kinds, self._begun_s = tuple(dict.fromkeys(kinds)), now

    def tell(self, state: SchedulerState, now: float, shortage: Callable[[], str]) -> None:
        """Tell what has changed. `shortage` is called only if it is told."""
        since_s = state.down_since_s if is_waiting(state) else None
        waits = since_s is not None and now >= since_s + NOTICE_S
        if waits != self._waits:
            self._waits = waits
            self._on_wait(shortage() if waits else "")
        compiles = text = ""
        if since_s is None and now >= self._begun_s + SILENCE_S:
            compiles = next((kind for kind in self._kinds if _compiles_for(state, kind)), "")
            text = _preparing(state)
        if (compiles, text) != self._told and (not text or now >= self._text_s + AGAIN_S):
            self._told, self._text_s = (compiles, text), now if text else self._text_s
            self._on_compile(compiles, text)


def _preparing(state: SchedulerState) -> str:
    """How many environments workers make now, of how many; if none does, how many they reset."""
    doing = min((report.doing for report in state.preparing.values()), default="")  # "making" is before "resetting"
    reports = [report for report in state.preparing.values() if report.doing == doing]
    done, total = sum(report.done for report in reports), sum(report.total for report in reports)
    return str(Progress(0, doing, done, total)) if doing else ""


def _compiles_for(state: SchedulerState, kind: str) -> bool:
    """Whether nobody has compiled for this kind so far, and a worker does so or none is up."""
    if kind in state.durations_s or any(kind in worker.warm for worker in state.up.values()):
        return False
    return not state.up or any(worker.slots and worker.slots[0].item.kind == kind for worker in state.up.values())


# The time in which workers compute: without their starting and compiling, and waits for them.


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
        return self._total_s + (0.0 if self._since_s is None else now - self._since_s)
