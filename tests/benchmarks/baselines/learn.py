"""One run of a learner, in the environment of the learners; `python -m tests.benchmarks.baselines` starts it.

    python -m tests.benchmarks.baselines.learn '{"task": "ant_trap", "system": "sac", "seed": 0, "folder": ..., ...}'

It ends with the process that started it. It goes on from the folder's checkpoint if there is one, certifies the policy
that it has at the end, and prints its row as one line of JSON. The policy is the newest one: nothing is selected.
"""

from __future__ import annotations

import json
import os
import pickle
import resource
import shutil
import sys
from pathlib import Path
from typing import Any

import cloudpickle
import jax
import numpy as np

from es_service.protocol.machine import cpu_kind
from es_service.protocol.parent import end_with
from es_service.runs.certification import EPISODES
from tests.benchmarks.baselines.episodes import certification_episodes
from tests.benchmarks.baselines.systems import BUFFER, SIZES, SYSTEMS, made
from tests.learners.environment import versions

CHUNK_STEPS = 16_384
"""Environment steps between looks at the budget."""
CHECKPOINT_S = 600.0
"""CPU seconds between checkpoints."""
OF_THE_PROCESS = ("env", "replay_buffer", "_logger", "_custom_logger", "_vec_normalize_env")
"""Attributes of a learner that a checkpoint has by itself, or that each process makes anew."""
NEWEST = "newest"
"""File with the name of the folder of the newest checkpoint."""


def cpu_seconds() -> float:
    """CPU time of this process and its children, in seconds."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


class Run:
    """A learner with its environments and its checkpoints."""

    def __init__(self, task: str, system: str, seed: int, folder: Path, buffer: int = BUFFER) -> None:
        """Begin, or go on from the newest checkpoint."""
        self.task, self.system, self.seed, self.folder = task, system, seed, folder
        self.learner, self._envs, self._wrapper = made(system, task, seed, buffer)
        self._before = -cpu_seconds()
        """CPU seconds of earlier sessions, less those of this process before the learner was there."""
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / NEWEST).exists():
            self._restore(folder / (folder / NEWEST).read_text())

    @property
    def cpu_seconds(self) -> float:
        """CPU seconds of all sessions."""
        return self._before + cpu_seconds()

    @property
    def steps(self) -> int:
        """Environment steps of all sessions."""
        return self.learner.num_timesteps

    def work(self, steps: int, seconds: float, chunk: int = CHUNK_STEPS) -> None:
        """Learn until one of the budgets is spent, with checkpoints."""
        kept = self.cpu_seconds
        while self.steps < steps and self.cpu_seconds < seconds:
            self.learner.learn(min(chunk, steps - self.steps), reset_num_timesteps=self.steps == 0)
            if self.cpu_seconds - kept > CHECKPOINT_S:
                self.keep()
                kept = self.cpu_seconds

    def keep(self) -> None:
        """Store a checkpoint; the one before stays until this one is whole."""
        name = f"at-{self.steps}"
        new = self.folder / name
        shutil.rmtree(new, ignore_errors=True)
        new.mkdir()
        learnt = {name: value for name, value in vars(self.learner).items() if name not in OF_THE_PROCESS}
        (new / "learner.pkl").write_bytes(cloudpickle.dumps(learnt))  # its own `save` leaves out the state of its keys
        self.learner.save_replay_buffer(new / "buffer.pkl")
        rest = {
            "environments": self._envs.environments.get_state(),
            "wrapper": None if self._wrapper is None else self._wrapper.get_state(),
            "random": np.random.get_state(),  # noqa: NPY002 - Stable-Baselines3 draws from it
            "cpu_seconds": self.cpu_seconds,
        }
        (new / "rest.pkl").write_bytes(pickle.dumps(rest))
        pointer = self.folder / f"{NEWEST}.new"
        pointer.write_text(name)
        os.replace(pointer, self.folder / NEWEST)
        for old in self.folder.glob("at-*"):
            if old != new:
                shutil.rmtree(old)

    def _restore(self, kept: Path) -> None:
        vars(self.learner).update(pickle.loads((kept / "learner.pkl").read_bytes()))
        self.learner.load_replay_buffer(kept / "buffer.pkl")
        rest = pickle.loads((kept / "rest.pkl").read_bytes())
        self._envs.environments.set_state(rest["environments"])
        if self._wrapper is not None:
            self._wrapper.set_state(rest["wrapper"])
        np.random.set_state(rest["random"])  # noqa: NPY002
        self._before += rest["cpu_seconds"]

    def row(self, *, is_finished: bool, episodes: int = EPISODES) -> dict[str, Any]:
        """The run's row, with the certified value of its newest policy."""
        steps, seconds, sizes = self.steps, self.cpu_seconds, SIZES[self.task]
        found = certification_episodes(
            lambda observation: self.learner.predict(observation, deterministic=True)[0],
            self.task,
            self.seed,
            count=episodes,
        ).values()
        successes = found["successes"]
        return {
            "task": self.task,
            "system": self.system,
            "seed": self.seed,
            "steps": steps,
            "cpu_seconds": seconds,
            "is_finished": is_finished,
            **{name: found[name] for name in ("return_mean", "return_low", "return_high")},
            "success": None if successes is None else successes / episodes,
            **{name: found[name] for name in ("success_low", "success_high")},
            "episodes": episodes,
            "updates_per_step": sizes.updates / sizes.environments,
            "network": "x".join(map(str, sizes.network)),
            "settings": SYSTEMS[self.system].settings,
            "versions": ", ".join(f"{name} {found}" for name, found in versions().items()) + f", jax {jax.__version__}",
            "cpu": cpu_kind(),
        }


def main() -> None:
    asked = json.loads(sys.argv[1])
    end_with(asked.pop("parent"))
    steps, seconds = asked.pop("steps"), asked.pop("cpu_seconds")
    run = Run(**asked | {"folder": Path(asked["folder"])})
    before = run.steps
    run.work(steps, seconds)
    if run.steps != before:
        run.keep()
    print(json.dumps(run.row(is_finished=run.steps >= steps or run.cpu_seconds >= seconds)))


if __name__ == "__main__":
    main()
