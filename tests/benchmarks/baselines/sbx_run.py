"""A run of a learner of sbx: TD3, SAC or RND."""

from __future__ import annotations

import pickle
from pathlib import Path

import cloudpickle
import numpy as np

from tests.benchmarks.baselines.episodes import certification_episodes
from tests.benchmarks.baselines.run import SIZES, Facts, Found, Run
from tests.benchmarks.baselines.sbx_systems import BUFFER, SYSTEMS, made

OF_THE_PROCESS = ("env", "replay_buffer", "_logger", "_custom_logger", "_vec_normalize_env")
"""Attributes of a learner that a checkpoint has by itself, or that each process makes anew."""


class SbxRun(Run):
    """A learner with its environments. What it has found is its newest policy: nothing is chosen."""

    def __init__(self, task: str, system: str, seed: int, folder: Path, buffer: int = BUFFER) -> None:
        """`buffer`: number of transitions that are kept."""
        sizes = SIZES[task]
        self.learner, self._envs, self._wrapper = made(system, task, seed, buffer)
        self.facts = Facts(
            sizes.updates / sizes.environments,
            sizes.network,
            SYSTEMS[system].settings,
            ("sbx-rl", "stable-baselines3"),
        )
        super().__init__(task, system, seed, folder)

    @property
    def steps(self) -> int:
        """Environment steps of all sessions."""
        return self.learner.num_timesteps

    def advance(self, steps: int) -> None:
        """Learn for so many environment steps."""
        self.learner.learn(steps, reset_num_timesteps=self.steps == 0)

    def write(self, folder: Path) -> None:
        """Write learner, buffer, environments, and the state of NumPy's random numbers."""
        learnt = {name: value for name, value in vars(self.learner).items() if name not in OF_THE_PROCESS}
        (folder / "learner.pkl").write_bytes(cloudpickle.dumps(learnt))  # its own `save` leaves out its keys' state
        self.learner.save_replay_buffer(folder / "buffer.pkl")
        rest = {
            "environments": self._envs.environments.get_state(),
            "wrapper": None if self._wrapper is None else self._wrapper.get_state(),
            "random": np.random.get_state(),  # noqa: NPY002 - Stable-Baselines3 draws from it
        }
        (folder / "rest.pkl").write_bytes(pickle.dumps(rest))

    def read(self, folder: Path) -> None:
        """Go on from what `write` has written."""
        vars(self.learner).update(pickle.loads((folder / "learner.pkl").read_bytes()))
        self.learner.load_replay_buffer(folder / "buffer.pkl")
        rest = pickle.loads((folder / "rest.pkl").read_bytes())
        self._envs.environments.set_state(rest["environments"])
        if self._wrapper is not None:
            self._wrapper.set_state(rest["wrapper"])
        np.random.set_state(rest["random"])  # noqa: NPY002

    def certified(self, episodes: int) -> Found:
        """The newest policy in certification episodes."""

        def policy(observation: np.ndarray) -> np.ndarray:
            return self.learner.predict(observation, deterministic=True)[0]

        return Found(certification_episodes(policy, self.task, self.seed, count=episodes), 1)
