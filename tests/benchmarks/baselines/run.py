"""A run of any system: steps until a budget is spent, checkpoints, and a row with the certified value of what it found.

Axes: N candidates, D policy parameters.
"""

from __future__ import annotations

import os
import resource
import shutil
from abc import ABC, abstractmethod
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

import es_service
from es_service.protocol.machine import cpu_kind
from es_service.runs.certification import EPISODES
from es_service.runs.selection import StoredEpisodes

CHECKPOINT_S = 600.0
"""CPU seconds between checkpoints."""
NEWEST = "newest"
"""File with the name of the folder of the newest checkpoint."""
CPU_SECONDS = "cpu_seconds"
"""File of a checkpoint with the CPU seconds of all sessions so far."""


COMPUTE = {
    "engine": "inline",
    "workers": 1,
    "rollout": "simd",
    **dict.fromkeys(("chunk_timeout_s", "compile_timeout_s", "no_worker_timeout_s"), 86_400),
}
"""One worker, for which runs of the lowest priority wait as long as a busy machine takes."""


@dataclass(frozen=True)
class Sizes:
    """What a task has of its own."""

    network: tuple[int, ...]
    environments: int
    updates: int
    """Updates for each step of all environments: one for 16 steps."""
    random_steps: int
    """Steps with random actions, before the first update."""


SIZES = {
    "point_maze": Sizes((64, 64), 16, 1, 1_000),
    "ant_maze": Sizes((256, 256), 64, 4, 10_000),
    "ant_trap": Sizes((256, 256), 64, 4, 10_000),
}


@dataclass(frozen=True)
class Facts:
    """What a row says about a system beside what it found."""

    updates_per_step: float
    """Batches that networks learn from, for each environment step; 0 without a gradient of a network."""
    network: tuple[int, ...]
    settings: str
    packages: tuple[str, ...]
    """Distributions whose versions the row names."""


@dataclass(frozen=True)
class Found:
    """The policy that a run has found, in certification episodes."""

    episodes: StoredEpisodes
    candidates: int
    """Number of policies from which selection episodes chose it; 1 if nothing was chosen."""


def cpu_seconds() -> float:
    """CPU time of this process and of its children, those that have ended and those that live, in seconds."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    ticks = 0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # a process that has just ended
            fields = stat.read_text().rpartition(")")[2].split()
            if int(fields[1]) == os.getpid():
                ticks += sum(map(int, fields[11:15]))  # its own, and of its children that have ended
    return sum(usage.ru_utime + usage.ru_stime for usage in used) + ticks / os.sysconf("SC_CLK_TCK")


class Run(ABC):
    """A system that learns a task, in one process. A subclass makes it new in `__init__` and calls that of this class
    last, which goes on from the newest checkpoint if there is one."""

    chunk = 16_384
    """Environment steps between looks at the budget."""
    facts: Facts

    def __init__(self, task: str, system: str, seed: int, folder: Path) -> None:
        self.task, self.system, self.seed, self.folder = task, system, seed, folder
        self._before = -cpu_seconds()
        """CPU seconds of earlier sessions, less those of this process before the system was there."""
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / NEWEST).exists():
            kept = folder / (folder / NEWEST).read_text()
            self.read(kept)
            self._before += float((kept / CPU_SECONDS).read_text())

    @property
    @abstractmethod
    def steps(self) -> int:
        """Environment steps of all sessions."""

    @abstractmethod
    def advance(self, steps: int) -> None:
        """Learn for so many environment steps, or a few more."""

    @abstractmethod
    def write(self, folder: Path) -> None:
        """Write all that `read` needs into a new folder."""

    @abstractmethod
    def read(self, folder: Path) -> None:
        """Go on from what `write` has written."""

    @abstractmethod
    def certified(self, episodes: int) -> Found:
        """What the run has found so far, in so many certification episodes."""

    @property
    def cpu_seconds(self) -> float:
        """CPU seconds of all sessions."""
        return self._before + cpu_seconds()

    def work(self, steps: int, seconds: float) -> None:
        """Learn until one of the budgets is spent, with checkpoints."""
        kept = self.cpu_seconds
        while self.steps < steps and self.cpu_seconds < seconds:
            self.advance(min(self.chunk, steps - self.steps))
            if self.cpu_seconds - kept > CHECKPOINT_S:
                self.keep()
                kept = self.cpu_seconds

    def keep(self) -> None:
        """Store a checkpoint; the one before stays until this one is whole."""
        name = f"at-{self.steps}"
        new = self.folder / name
        shutil.rmtree(new, ignore_errors=True)
        new.mkdir()
        self.write(new)
        (new / CPU_SECONDS).write_text(str(self.cpu_seconds))
        pointer = self.folder / f"{NEWEST}.new"
        pointer.write_text(name)
        os.replace(pointer, self.folder / NEWEST)
        for old in self.folder.glob("at-*"):
            if old != new:
                shutil.rmtree(old)

    def row(self, *, is_finished: bool, episodes: int = EPISODES) -> dict[str, Any]:
        """The run's row, with the certified value of what it has found."""
        steps, seconds = self.steps, self.cpu_seconds
        certified = self.certified(episodes)
        values = certified.episodes.values()
        successes = values["successes"]
        names = [f"{what}_{part}" for what in ("return", "goal_distance") for part in ("mean", "low", "high")]
        return {
            "task": self.task,
            "system": self.system,
            "seed": self.seed,
            "steps": steps,
            "cpu_seconds": seconds,
            "is_finished": is_finished,
            **{name: values[name] for name in names},
            "success": None if successes is None else successes / episodes,
            **{name: values[name] for name in ("success_low", "success_high")},
            "episodes": episodes,
            "candidates": certified.candidates,
            "updates_per_step": self.facts.updates_per_step,
            "network": "x".join(map(str, self.facts.network)) or "linear",
            "settings": self.facts.settings,
            "versions": ", ".join(
                f"{name} {metadata.version(name).partition('+')[0]}" for name in (*self.facts.packages, "jax")
            ),
            "cpu": cpu_kind(),
        }


def relu_config(task: str, seed: int) -> dict[str, Any]:
    """A config of the task with the policy of these systems: ReLU, tanh at the end, observations as they are."""
    return {
        "task": {"environment": task},
        "policy": {
            "hidden": list(SIZES[task].network),
            "activation": "relu",
            "observation_normalization": False,
            "action_noise": 0.0,
        },
        "search": {"algorithm": "es"},
        "budget": {"generations": 1},
        "compute": COMPUTE,
        "seed": seed,
    }


def chosen_and_certified(parameters_N_D: ArrayLike, config: Mapping[str, Any], episodes: int) -> Found:
    """The best of N policies by selection episodes, in certification episodes."""
    [policy] = es_service.certify(parameters_N_D, config, episodes=episodes)
    return Found(policy.episodes, policy.candidates)
