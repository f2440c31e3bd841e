"""What work waits for when nothing is heard of it: a first place in a cluster, or workers that start and compile."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

from es_service.dispatch.scheduler_state import SchedulerState, is_waiting

NOTICE_S = 5.0
"""Seconds without a first place after which a run is said to wait. A cluster with room takes less to start a process.
"""
SILENCE_S = 2.0
"""Seconds of a phase after which workers are said to compile for it."""


class Waits:
    """Tells of waits as they begin and end."""

    def __init__(self, on_wait: Callable[[str], None], on_compile: Callable[[str], None]) -> None:
        """Tell of nothing yet.

        Args:
            on_wait: called with `Transport.shortage` when work has waited for a first place for NOTICE_S seconds, and
                with "" when that wait is over.
            on_compile: called with a kind of chunks when SILENCE_S seconds of a phase have passed and the first workers
                start or compile for this kind; and with "" when one of them has compiled.
        """
        self._on_wait, self._waits = on_wait, False
        self._on_compile, self._compiles = on_compile, ""
        self._kinds: tuple[str, ...] = ()
        self._begun_s = math.inf

    def begin(self, kinds: Iterable[str], now: float) -> None:
        """A phase begins, with chunks of these kinds."""
        self._kinds, self._begun_s = tuple(dict.fromkeys(kinds)), now

    def tell(self, state: SchedulerState, now: float, shortage: Callable[[], str]) -> None:
        """Tell what has changed. `shortage` is called only if it is told."""
        since_s = state.down_since_s if is_waiting(state) else None
        waits = since_s is not None and now >= since_s + NOTICE_S
        if waits != self._waits:
            self._waits = waits
            self._on_wait(shortage() if waits else "")
        compiles = ""
        if since_s is None and now >= self._begun_s + SILENCE_S:
            compiles = next((kind for kind in self._kinds if _compiles_for(state, kind)), "")
        if compiles != self._compiles:
            self._compiles = compiles
            self._on_compile(compiles)


def _compiles_for(state: SchedulerState, kind: str) -> bool:
    """Whether nobody has compiled for this kind so far, and a worker does so or none is up."""
    if kind in state.durations_s or any(kind in worker.warm for worker in state.up.values()):
        return False
    return not state.up or any(worker.slots and worker.slots[0].item.kind == kind for worker in state.up.values())
