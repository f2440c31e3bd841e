"""Our tasks as environments of Gymnasium, single and as a vector, over one call of the compiled step for all.

Axes: N environments, O observation, A action, B descriptor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from es_service.environments.drawing import FRAMES_PER_SECOND, MODES, Trails, modes_of, require_mode
from es_service.protocol.messages import TaskSpec
from es_service.protocol.options import OptionValue
from workers.lanes import LaneResults, Lanes, LanesState


def observation_space(task: TaskSpec) -> Box:
    """Observations have no bounds."""
    return Box(-np.inf, np.inf, (task.observation_size,), np.float32)


def action_space(task: TaskSpec) -> Box:
    return Box(-1.0, 1.0, (task.action_size,), np.float32)


def info_of(task: TaskSpec, seen: LaneResults) -> dict[str, Any]:
    """The entries of `info`, with the axes of what is seen."""
    distance = {"goal_distance": seen.goal_distance} if task.has_goal else {}
    return {"descriptor": seen.descriptor, "success": seen.success} | distance


def seed_given(seed: int) -> int:
    """A seed that a caller gives. Raises ValueError if it is negative or has more than 63 bits."""
    if not 0 <= seed < 2**63:
        raise ValueError(f"seed = {seed}; must be from 0 to 2**63 - 1")
    return seed


def random_seed() -> int:
    """A seed for an environment that was given none."""
    return int(np.random.SeedSequence().generate_state(1, np.uint64)[0] >> np.uint64(1))


Returned = tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]


State = tuple[LanesState, NDArray[np.bool_], NDArray[np.float32]]
"""State of the task, which episodes are over [N], and the last observations [N, O]."""


class TaskVectorEnv(VectorEnv[Any, Any, Any]):
    """Environments of a task side by side.

    Environment i has the same bits whatever `num_envs` and `threads` are and on whatever processor: they depend on its
    seed, the number of its episodes since then, and its actions. `SyncVectorEnv` of as many `TaskEnv` gives the same.
    What simd cannot compile of a task, its resets or its steps too, xla computes in blocks of 16 environments, in a
    child process, and a warning says why. Then the bits also depend on i modulo 16 (`index` of a `TaskEnv`) and on the
    kind of the processor.

    `info` has, for every environment, `descriptor` [N, B] (where the episode would end in the map), `success` [N], and
    `goal_distance` [N] if the task has a goal. Actions outside of [-1, 1] are clipped.
    """

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        task_options: Mapping[str, OptionValue] | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        threads: int = 1,
        copy: bool = True,
        render_mode: str | None = None,
    ) -> None:
        """Compile the task's step, or take it from the cache.

        Args:
            task: a shipped task (as `es-service list` shows), `brax:NAME`, `mujoco:ID`, or module:Class of a class
                in JAX.
            num_envs: number of environments.
            max_episode_steps: steps after which an episode is truncated; None: the task's own number.
            task_options: options of the task, such as {"start": "corner"}.
            autoreset_mode: what happens after an episode. SAME_STEP: the step returns the next episode's first
                observation, and `info["final_obs"]` and `info["final_info"]` what the episode ended with. NEXT_STEP:
                the next step ignores its action and returns that observation. DISABLED: the caller resets, with
                `reset(options={"reset_mask": ...})`.
            threads: threads that step the environments, or processes where xla does; results do not depend on it.
            copy: whether `reset` and `step` return new arrays of observations. If not, all of them return the same
                array, whose content the next call replaces, and which must not be changed.
            render_mode: None, or "rgb_array" for pictures from above; see `environments.drawing`.

        Raises:
            TaskError: there is no such task or option, or the task cannot be computed.
            ValueError: another argument is wrong.
        """
        for name, value in (("num_envs", num_envs), ("threads", threads), ("max_episode_steps", max_episode_steps)):
            if value is not None and (not isinstance(value, int | np.integer) or value is True or value < 1):
                raise ValueError(f"{name} = {value!r}; must be at least 1, and a whole number")
        require_mode(render_mode)
        self.render_mode, self._copies = render_mode, copy
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self._lanes = Lanes(task, task_options or {}, num_envs, threads)
        self.num_envs = num_envs
        self.task = self._lanes.task
        self.metadata = {
            "autoreset_mode": self.autoreset_mode,
            "render_modes": modes_of(self.task),
            "render_fps": FRAMES_PER_SECOND,
        }
        self.max_episode_steps = self.task.episode_steps if max_episode_steps is None else max_episode_steps
        self.single_observation_space, self.single_action_space = observation_space(self.task), action_space(self.task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._is_seeded_N = np.zeros(num_envs, bool)
        self._is_over_N = np.zeros(num_envs, bool)
        self._observation_N_O = np.zeros((num_envs, self.task.observation_size), np.float32)
        self._trails = None if render_mode is None else Trails(self.task, num_envs)

    def reset(  # the base class takes only one number
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode in every environment, or in those of `options["reset_mask"]`.

        Args:
            seed: environment i gets seed + i, or the i-th of a list; None: its episodes go on, with a random seed if it
                never had one.
            options: `reset_mask`, an array of `num_envs` bools of which at least one is true.

        Returns:
            The observations of all environments, and the info of those that were reset.
        """
        self._require_open()
        seeds = self._seeds(seed)
        lane_M = np.flatnonzero(self._mask(options))
        for lane in lane_M.tolist():
            if (given := seeds[lane]) is not None or not self._is_seeded_N[lane]:
                self._lanes.seed_N[lane] = random_seed() if given is None else given
                self._lanes.episode_N[lane] = -1
        self._is_seeded_N[lane_M] = True
        info = self._info(self._begin(lane_M), lane_M)
        return self._returned(), info

    def step(self, actions: ArrayLike) -> Returned:
        """Step every environment with its action [N, A].

        Raises:
            ValueError: the actions have another shape.
            ResetNeeded: no episode has begun, or one is over that the caller has to reset.
            ClosedEnvironmentError: the environments are closed.
        """
        self._require_open()
        action_N_A = np.asarray(actions, np.float32)
        if action_N_A.shape != self.action_space.shape:
            raise ValueError(f"actions have the shape {action_N_A.shape}; must be {self.action_space.shape}")
        self._require_reset("step")
        over_before_N = self._is_over_N
        if self.autoreset_mode == AutoresetMode.DISABLED and over_before_N.any():
            which = np.flatnonzero(over_before_N)
            raise ResetNeeded(
                f"the episode of environment {which[0]} is over; reset it with options={{'reset_mask': ...}}, or "
                "choose another autoreset_mode"
            )
        seen = self._lanes.step(action_N_A)
        terminated_N, truncated_N = seen.done, self._lanes.steps_N >= self.max_episode_steps
        reward_N = seen.reward.astype(np.float64)
        self._observation_N_O[:] = seen.observation
        if self._trails is not None:
            self._trails.move(np.arange(self.num_envs), seen.descriptor)
        self._is_over_N = terminated_N | truncated_N
        info: dict[str, Any] = {}
        shown = {name: array.copy() for name, array in info_of(self.task, seen).items()}
        if self.autoreset_mode == AutoresetMode.NEXT_STEP and over_before_N.any():
            lane_M = np.flatnonzero(over_before_N)
            self._put(shown, self._begin(lane_M), lane_M)
            reward_N[lane_M], terminated_N[lane_M], truncated_N[lane_M] = 0.0, False, False
        elif self.autoreset_mode == AutoresetMode.SAME_STEP and (terminated_N | truncated_N).any():
            lane_M = np.flatnonzero(terminated_N | truncated_N)
            last = LaneResults(*(array[lane_M] for array in seen))
            final_obs = np.full(self.num_envs, None, object)
            for lane in lane_M.tolist():
                final_obs[lane] = seen.observation[lane].copy()
            info |= self._masked({"final_obs": final_obs, "final_info": self._info(last, lane_M)}, lane_M)
            self._put(shown, self._begin(lane_M), lane_M)
        info |= self._masked(shown, np.arange(self.num_envs))
        return self._returned(), reward_N, terminated_N, truncated_N, info

    def get_state(self) -> State:
        """State of all environments, from which `set_state` of as many of the same task goes on, bit for bit. Raises
        ResetNeeded before the first reset."""
        self._require_reset("get_state")
        return self._lanes.state(), self._is_over_N.copy(), self._observation_N_O.copy()

    def set_state(self, state: State) -> None:
        """Go on from what `get_state` has returned; the next step is that of those environments."""
        self._require_open()
        lanes, is_over_N, observation_N_O = state
        self._lanes.set_state(lanes)
        self._observation_N_O[:] = observation_N_O
        self._is_over_N = is_over_N.copy()
        self._is_seeded_N[:] = True
        if self._trails is not None:
            self._trails.forget()

    def frame(self, index: int) -> NDArray[np.uint8]:
        """Picture of one environment, [256, 256, 3]. Raises ValueError if `render_mode` is None, or if there is no such
        environment."""
        if self._trails is None:
            raise ValueError("render_mode = None; must be 'rgb_array' for pictures")
        if not 0 <= index < self.num_envs:
            raise ValueError(f"index = {index}; must be from 0 to {self.num_envs - 1}")
        return self._trails.frame(index)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Pictures of all environments, as Gymnasium's wrappers want them; None if `render_mode` is None."""
        return None if self._trails is None else tuple(self._trails.frame(lane) for lane in range(self.num_envs))

    def close_extras(self, **_: Any) -> None:
        self._lanes.close()

    def _require_open(self) -> None:
        if self.closed:
            raise ClosedEnvironmentError("the environments are closed; make others")

    def _require_reset(self, before: str) -> None:
        self._require_open()
        if not self._is_seeded_N.all():
            raise ResetNeeded(f"call reset before {before}")

    def _begin(self, lane_M: NDArray[np.intp]) -> LaneResults:
        """Reset some environments; returns what is seen in these."""
        seen = self._lanes.reset(lane_M)
        self._observation_N_O[lane_M] = seen.observation
        self._is_over_N[lane_M] = False
        if self._trails is not None:
            self._trails.begin(lane_M, seen.descriptor)
        return seen

    def _returned(self) -> NDArray[np.float32]:
        return self._observation_N_O.copy() if self._copies else self._observation_N_O

    def _put(self, shown: dict[str, NDArray], seen: LaneResults, lane_M: NDArray[np.intp]) -> None:
        for name, array in info_of(self.task, seen).items():
            shown[name][lane_M] = array

    def _info(self, seen: LaneResults, lane_M: NDArray[np.intp]) -> dict[str, Any]:
        """The info of some environments, as Gymnasium has it: zeros for the others, and a mask for each name."""
        shown = {}
        for name, array in info_of(self.task, seen).items():
            shown[name] = np.zeros((self.num_envs, *array.shape[1:]), array.dtype)
            shown[name][lane_M] = array
        return self._masked(shown, lane_M)

    def _masked(self, shown: Mapping[str, Any], lane_M: NDArray[np.intp]) -> dict[str, Any]:
        mask_N = np.zeros(self.num_envs, bool)
        mask_N[lane_M] = True
        return {
            key: value for name, array in shown.items() for key, value in ((name, array), (f"_{name}", mask_N.copy()))
        }

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, int | np.integer):
            return [seed_given(int(seed) + lane) for lane in range(self.num_envs)]
        if not isinstance(seed, Sequence | np.ndarray) or any(
            not isinstance(one, int | np.integer | None) for one in seed
        ):
            raise ValueError(f"seed = {seed!r}; must be a whole number, or a list of these or None")
        if len(seed) != self.num_envs:
            raise ValueError(
                f"seed is a list of {len(seed)}; must have one for each of the {self.num_envs} environments"
            )
        return [None if lane_seed is None else seed_given(int(lane_seed)) for lane_seed in seed]

    def _mask(self, options: Mapping[str, Any] | None) -> NDArray[np.bool_]:
        mask_N = (options or {}).get("reset_mask")
        if mask_N is None:
            return np.ones(self.num_envs, bool)
        if not isinstance(mask_N, np.ndarray) or mask_N.dtype != bool:
            raise TypeError(f"options['reset_mask'] is {type(mask_N).__name__}; must be a NumPy array of bools")
        if mask_N.shape != (self.num_envs,) or not mask_N.any():
            raise ValueError(
                f"options['reset_mask'] has the shape {mask_N.shape} and {int(mask_N.sum())} true values; must have "
                f"one value for each of the {self.num_envs} environments, and at least one true"
            )
        return mask_N


# Our tasks as single environments of Gymnasium: one lane of the compiled step. A `TaskVectorEnv` has many.

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
