"""Our tasks as a `VecEnv` of Stable-Baselines3, for its algorithms and those of sbx and sb3-contrib.

    from sbx import SAC
    from es_service.environments.sb3 import SB3VecEnv
    SAC("MlpPolicy", SB3VecEnv("ant_trap", 64)).learn(100_000)

Importing this module imports Stable-Baselines3, which es-service does not install.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.environments.vector import TaskVectorEnv

try:
    _vec_env: Any = importlib.import_module("stable_baselines3.common.vec_env")
except ModuleNotFoundError as error:
    if (error.name or "").partition(".")[0] != "stable_baselines3":
        raise
    raise ModuleNotFoundError(
        "es_service.environments.sb3 needs Stable-Baselines3, in an environment of its own since it brings PyTorch: "
        "pip install stable-baselines3 (or sbx-rl, with algorithms in JAX)",
        name=error.name,
    ) from error


class SB3VecEnv(_vec_env.VecEnv):
    """Environments of a task side by side, with the bits of a `TaskVectorEnv` in the mode SAME_STEP.

    The info of each environment has `descriptor` [B], `is_success`, `goal_distance` if the task has a goal, and where
    an episode has ended `terminal_observation` and `TimeLimit.truncated`. Rewards are float32.
    """

    def __init__(self, task: str, num_envs: int = 1, **settings: Any) -> None:
        """Make the environments.

        Args:
            task, num_envs, settings: those of `TaskVectorEnv`, without `autoreset_mode`. With `copy=False`,
                observations are one array whose content the next call replaces, which algorithms with a replay buffer
                do not expect.

        Raises:
            TaskError, ValueError: as `TaskVectorEnv`.
        """
        if "autoreset_mode" in settings:
            raise ValueError("autoreset_mode cannot be chosen: a VecEnv resets an environment in its last step")
        self.environments = TaskVectorEnv(task, num_envs, **settings)
        """The environments as those of Gymnasium."""
        self._actions_N_A: NDArray | None = None
        super().__init__(num_envs, self.environments.single_observation_space, self.environments.single_action_space)

    def reset(self) -> NDArray[np.float32]:
        """Begin an episode in every environment, with the seeds of the last `seed` if that was called since."""
        if any(self._options):
            raise ValueError(f"set_options({self._options[0]!r}): a reset has no options")
        seeds = None if all(seed is None for seed in self._seeds) else self._seeds
        observation_N_O, info = self.environments.reset(seed=seeds)
        self.reset_infos = self._infos(info)
        self._reset_seeds()
        return observation_N_O

    def step_async(self, actions: NDArray) -> None:
        """Keep the actions [N, A] for `step_wait`."""
        self._actions_N_A = actions

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all environments; returns observations, rewards, whether episodes ended, infos."""
        if self._actions_N_A is None:
            raise ValueError("call step_async before step_wait")
        actions_N_A, self._actions_N_A = self._actions_N_A, None
        observation_N_O, reward_N, terminated_N, truncated_N, info = self.environments.step(actions_N_A)
        done_N = terminated_N | truncated_N
        infos = self._infos(info)
        for lane_info, truncated, terminated in zip(infos, truncated_N.tolist(), terminated_N.tolist(), strict=True):
            lane_info["TimeLimit.truncated"] = truncated and not terminated
        if done_N.any():
            lasts = self._infos(info["final_info"])
            for lane in np.flatnonzero(done_N).tolist():
                self.reset_infos[lane] = {key: infos[lane][key] for key in lasts[lane]}
                infos[lane] |= lasts[lane] | {"terminal_observation": info["final_obs"][lane]}
        return observation_N_O, reward_N.astype(np.float32), done_N, infos

    def close(self) -> None:
        """End threads and processes."""
        self.environments.close()

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """An attribute of the environments, which all of them share, once for each index.

        Raises:
            AttributeError: they have no such attribute.
        """
        value = getattr(self.environments, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Set an attribute of all environments. Raises ValueError for some of them."""
        if len(set(self._get_indices(indices))) != self.num_envs:
            raise ValueError(f"set_attr({attr_name!r}) of some environments: their attributes are those of all")
        setattr(self.environments, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: int | Iterable[int] | None = None, **method_kwargs: Any
    ) -> list[Any]:
        """Always raises AttributeError: one call steps all, so none of them is an object with methods."""
        raise AttributeError(
            f"env_method({method_name!r}): the environments are no objects of their own; call a method of all, "
            "SB3VecEnv.environments"
        )

    def env_is_wrapped(self, wrapper_class: type, indices: int | Iterable[int] | None = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Pictures of all environments if `render_mode` is "rgb_array"; see `environments.drawing`."""
        return self.environments.render() or [None] * self.num_envs

    def _infos(self, info: dict[str, Any]) -> list[dict[str, Any]]:
        """The info of each environment, without masks and final entries."""
        shown = {name: info[name] for name in ("descriptor", "goal_distance") if name in info}
        return [
            dict(zip((*shown, "is_success"), values, strict=True))
            for values in zip(*shown.values(), info["success"].tolist(), strict=True)
        ]
