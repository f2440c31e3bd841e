"""Our tasks as single environments of Gymnasium: one lane of the compiled step. A `TaskVectorEnv` has many."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from numpy.typing import ArrayLike, NDArray

from es_service.environments.drawing import FRAMES_PER_SECOND, MODES, Trails, modes_of, require_mode
from es_service.environments.vector import action_space, info_of, observation_space, random_seed, seed_given
from es_service.protocol.options import OptionValue
from workers.lanes import LaneResults, Lanes, LanesState

_FIRST = np.zeros(1, np.intp)


class TaskEnv(gymnasium.Env[Any, Any]):
    """One environment of a task, with the bits of environment `index` of a `TaskVectorEnv` with the same seed.

    `info` has `descriptor` [B] (where the episode would end in the map), `success`, and `goal_distance` if the task has
    a goal. Actions outside of [-1, 1] are clipped. It has no limit of steps: `gymnasium.make` adds that of a shipped
    task, and for others the one that it is given (`max_episode_steps`).
    """

    metadata = {"render_modes": list(MODES), "render_fps": FRAMES_PER_SECOND}  # noqa: RUF012 - as Gymnasium's

    def __init__(
        self,
        task: str,
        *,
        task_options: Mapping[str, OptionValue] | None = None,
        render_mode: str | None = None,
        index: int = 0,
    ) -> None:
        """Arguments and errors are those of `TaskVectorEnv`.

        Args:
            index: which environment of a `TaskVectorEnv` this one equals. It matters only for tasks that xla computes.
        """
        require_mode(render_mode)
        self.render_mode = render_mode
        self._lanes = Lanes(task, task_options or {}, 1, first=index)
        self.task = self._lanes.task
        self.metadata = {**self.metadata, "render_modes": modes_of(self.task)}
        self.observation_space, self.action_space = observation_space(self.task), action_space(self.task)
        self._trails = None if render_mode is None else Trails(self.task, 1)
        self._is_seeded = self._is_closed = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: None: its episodes go on, and have a random seed if it never had one.
            options: not used.
        """
        self._require_open()
        super().reset(seed=seed)
        if seed is not None or not self._is_seeded:
            self._lanes.seed_N[0] = random_seed() if seed is None else seed_given(seed)
            self._lanes.episode_N[0] = -1
            self._is_seeded = True
        seen = self._lanes.reset(_FIRST)
        if self._trails is not None:
            self._trails.begin(_FIRST, seen.descriptor)
        return seen.observation[0], self._info(seen)

    def step(self, action: ArrayLike) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Step with an action [A]. Raises ValueError if it has another shape, ResetNeeded before the first reset, and
        ClosedEnvironmentError after `close`."""
        self._require_open()
        action_A = np.asarray(action, np.float32)
        if action_A.shape != self.action_space.shape:
            raise ValueError(f"action has the shape {action_A.shape}; must be {self.action_space.shape}")
        self._require_reset("step")
        seen = self._lanes.step(action_A[None])
        if self._trails is not None:
            self._trails.move(_FIRST, seen.descriptor)
        return seen.observation[0], float(seen.reward[0]), bool(seen.done[0]), False, self._info(seen)

    def render(self) -> NDArray[np.uint8] | None:  # the base class allows more kinds
        """A picture from above, [256, 256, 3], if `render_mode` is "rgb_array"; see `environments.drawing`."""
        return None if self._trails is None else self._trails.frame(0)

    def get_state(self) -> LanesState:
        """State of the environment, from which `set_state` of another one of the task goes on, bit for bit. Raises
        ResetNeeded before the first reset."""
        self._require_reset("get_state")
        return self._lanes.state()

    def set_state(self, state: LanesState) -> None:
        """Go on from what `get_state` has returned."""
        self._require_open()
        self._lanes.set_state(state)
        if self._trails is not None:
            self._trails.forget()
        self._is_seeded = True

    def close(self) -> None:
        """End the process of a task that xla computes."""
        self._is_closed = True
        self._lanes.close()

    def _require_open(self) -> None:
        if self._is_closed:
            raise ClosedEnvironmentError("the environment is closed; make another one")

    def _require_reset(self, before: str) -> None:
        self._require_open()
        if not self._is_seeded:
            raise ResetNeeded(f"call reset before {before}")

    def _info(self, seen: LaneResults) -> dict[str, Any]:
        shown = {name: array[0] for name, array in info_of(self.task, seen).items()}
        return shown | {"success": bool(shown["success"])}
