"""AntMaze and AntTrap in C MuJoCo, as environments of Gymnasium.

They are the tasks `ant_maze` and `ant_trap` with the option `physics: mujoco`, which MJX computes: same model, rewards,
observations and ends. `es_service.gymnasium` registers them as `es_service/AntMazeMujoco-v0` and
`es_service/AntTrapMujoco-v0`. This module imports no JAX.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray

from workers.environments import SHIPPED
from workers.environments.ant_model import SUBSTEPS, ant_model, first_qpos
from workers.environments.ant_tasks import (
    FORCE_LIMIT,
    JOINTS,
    MAZE_BOUNDS,
    MAZE_GOAL,
    MAZE_NEAR,
    MAZE_START,
    RESET_NOISE,
    STEP_S,
    TRAP_BEYOND_X,
    TRAP_CONTACT_COST,
    TRAP_CONTROL_COST,
    TRAP_HEALTHY_Z,
    TRAP_START,
    TRAP_SURVIVAL_REWARD,
)

mj: Any = mujoco  # its module does not say what it contains


class MujocoAntEnv(gymnasium.Env[Any, Any]):
    """An ant among walls in C MuJoCo.

    `info` has `descriptor` [2] (where the episode would end in the map), `is_success`, and `goal_distance` in AntMaze.
    Actions outside of [-1, 1] are clipped. It has no limit of steps: `gymnasium.make` adds that of the task.
    """

    metadata = {"render_modes": [], "render_fps": round(1 / STEP_S)}  # noqa: RUF012 - as Gymnasium's
    task: str
    start: tuple[float, float]

    def __init__(self, render_mode: str | None = None) -> None:
        """Load the model.

        Raises:
            ValueError: `render_mode` is not None.
        """
        if render_mode is not None:
            raise ValueError(
                f"render_mode = {render_mode!r}; must be None. es-service report shows episodes in three dimensions"
            )
        spec = SHIPPED[self.task]
        self.model = ant_model(spec.walls or ())
        # Otherwise MuJoCo would put an ant whose state is not finite at its origin, and go on.
        self.model.opt.disableflags |= mj.mjtDisableBit.mjDSBL_AUTORESET
        self.data = mj.MjData(self.model)
        self.action_space = Box(-1.0, 1.0, (spec.action_size,), np.float32)
        self.observation_space = Box(-np.inf, np.inf, (spec.observation_size,), np.float32)
        self._first_qpos = first_qpos(self.model)
        self._has_succeeded = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: of the noise on the joints; None: the generator goes on.
            options: not used.
        """
        super().reset(seed=seed)
        noise = self.np_random.uniform(-RESET_NOISE, RESET_NOISE, 2 * JOINTS)
        qpos, qvel = self._first_qpos.copy(), np.zeros(self.model.nv)
        qpos[:2], qpos[7:], qvel[6:] = self.start, qpos[7:] + noise[:JOINTS], noise[JOINTS:]
        return self.set_state(qpos, qvel)

    def set_state(self, qpos: ArrayLike, qvel: ArrayLike) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode with positions [15] and velocities [14]; returns what `reset` returns."""
        mj.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        self._has_succeeded = False
        return self._observation(), self._info()

    def step(self, action: ArrayLike) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Step with an action [8]. Raises ValueError if it has another shape."""
        action_A = np.clip(np.asarray(action, float), -1.0, 1.0)
        if action_A.shape != self.action_space.shape:
            raise ValueError(f"action has the shape {action_A.shape}; must be {self.action_space.shape}")
        x = self.data.qpos[0]
        self.data.ctrl[:] = action_A
        mj.mj_step(self.model, self.data, nstep=SUBSTEPS)
        mj.mj_rnePostConstraint(self.model, self.data)
        reward, done = self._outcome(x, action_A)
        self._has_succeeded = self._succeeds(self._has_succeeded)
        return self._observation(), float(reward), bool(done), False, self._info()

    def _observation(self) -> NDArray[np.float32]:
        qpos, qvel = self.data.qpos, self.data.qvel
        return np.concatenate([self._position(), qpos[2:], qvel, self._forces()], dtype=np.float32)

    def _info(self) -> dict[str, Any]:
        return {"descriptor": self.data.qpos[:2].copy(), "is_success": bool(self._has_succeeded)}

    def _forces(self) -> NDArray:
        return np.zeros(0)

    def _position(self) -> NDArray:
        raise NotImplementedError

    def _outcome(self, x_before: float, action_A: NDArray) -> tuple[float, bool]:
        """(reward, whether the episode ends) of the step to the present state."""
        raise NotImplementedError

    def _succeeds(self, before: bool) -> bool:
        """Whether an episode that ends now succeeds, given whether it would have a step before."""
        raise NotImplementedError


class AntMazeEnv(MujocoAntEnv):
    """AntMaze in C MuJoCo."""

    task, start = "ant_maze", MAZE_START

    def _position(self) -> NDArray:
        low, high = MAZE_BOUNDS
        return (self.data.qpos[:2] - (low + high) / 2) / ((high - low) / 2)

    def _outcome(self, x_before: float, action_A: NDArray) -> tuple[float, bool]:
        return -self._distance(), False

    def _succeeds(self, before: bool) -> bool:
        return self._distance() <= MAZE_NEAR

    def _info(self) -> dict[str, Any]:
        return super()._info() | {"goal_distance": self._distance()}

    def _distance(self) -> float:
        return float(np.hypot(*(self.data.qpos[:2] - MAZE_GOAL)))


class AntTrapEnv(MujocoAntEnv):
    """AntTrap in C MuJoCo."""

    task, start = "ant_trap", TRAP_START

    def __init__(self, contact_forces: str = "computed", render_mode: str | None = None) -> None:
        """Load the model.

        Args:
            contact_forces: `computed`; or `zero` in observations and in the reward.

        Raises:
            ValueError: an argument has another value.
        """
        if contact_forces not in ("computed", "zero"):
            raise ValueError(f"contact_forces = {contact_forces!r}; must be computed or zero")
        self._scale = FORCE_LIMIT if contact_forces == "computed" else 0.0
        super().__init__(render_mode)

    def _position(self) -> NDArray:
        (x_low, x_high), (_, y_high) = SHIPPED[self.task].descriptor_bounds
        half = (x_high - x_low) / 2
        return np.array([(self.data.qpos[0] - x_low - half) / half, self.data.qpos[1] / y_high])

    def _forces(self) -> NDArray:
        return np.clip(self.data.cfrc_ext, -self._scale, self._scale).ravel()

    def _outcome(self, x_before: float, action_A: NDArray) -> tuple[float, bool]:
        z, forward = self.data.qpos[2], (self.data.qpos[0] - x_before) / STEP_S
        control, contact = TRAP_CONTROL_COST * (action_A**2).sum(), TRAP_CONTACT_COST * (self._forces() ** 2).sum()
        is_healthy = TRAP_HEALTHY_Z[0] <= z <= TRAP_HEALTHY_Z[1]
        return forward + TRAP_SURVIVAL_REWARD - control - contact, not is_healthy

    def _succeeds(self, before: bool) -> bool:
        return before or bool(self.data.qpos[0] > TRAP_BEYOND_X)

    def _info(self) -> dict[str, Any]:
        low, high = zip(*SHIPPED[self.task].descriptor_bounds, strict=True)
        return super()._info() | {"descriptor": np.clip(self.data.qpos[:2], low, high)}
