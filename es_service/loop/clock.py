"""Where the seconds of a run go."""

from __future__ import annotations

import time


class Clock:
    """Where the seconds of a generation go. Time of the commit is shown with the generation after it."""

    def __init__(self, before_s: float) -> None:
        self._origin = time.perf_counter() - before_s
        self._last = self._generation_start = time.perf_counter()
        self._laps: dict[str, float] = {}

    def total(self) -> float:
        """Seconds spent in this run, earlier sessions included."""
        return time.perf_counter() - self._origin

    def lap(self, name: str) -> None:
        """Book the time since the last lap under `name`."""
        now = time.perf_counter()
        self._laps[name] = self._laps.get(name, 0.0) + now - self._last
        self._last = now

    def finish_generation(self) -> tuple[float, dict[str, float]]:
        """(seconds since the last call, laps since then by name)."""
        now = time.perf_counter()
        seconds, laps = now - self._generation_start, self._laps
        self._generation_start, self._laps = now, {}
        names = ("seconds_rollout", "seconds_gradient", "seconds_evaluation", "seconds_driver", "seconds_store")
        return seconds, {name: laps.get(name, 0.0) for name in names}
