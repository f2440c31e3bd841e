"""Measurement of how the time of a run is spent."""

from __future__ import annotations

import time

from es_service.loop.budget import PHASES


class Clock:
    """Measures how the time of each generation is spent. The time in which a generation is stored counts for the
    following one, whose episodes are computed meanwhile.

    Args:
        before_s: seconds spent in earlier sessions of the run.
    """

    def __init__(self, before_s: float) -> None:
        self._origin = time.perf_counter() - before_s
        self._last = self._generation_start = time.perf_counter()
        self._laps: dict[str, float] = {}

    def total(self) -> float:
        """Seconds spent in this run, earlier sessions included."""
        return time.perf_counter() - self._origin

    def lap(self, name: str) -> None:
        """Add the time since the last lap to the total of `name`."""
        now = time.perf_counter()
        self._laps[name] = self._laps.get(name, 0.0) + now - self._last
        self._last = now

    def finish_generation(self) -> tuple[float, dict[str, float]]:
        """End a generation: (seconds since the end of the last one, seconds of its laps by history column)."""
        now = time.perf_counter()
        seconds, laps = now - self._generation_start, self._laps
        self._generation_start, self._laps = now, {}
        return seconds, {name: laps.get(name, 0.0) for name in PHASES}
