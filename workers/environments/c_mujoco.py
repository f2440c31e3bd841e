"""C MuJoCo beside what computes its models here: a control step of many states, and how far apart two answers are.

C MuJoCo computes in float64. A state that moves by one float32 ulp shows how exact a comparison can be: its own answer
moves, too.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from workers.environments.mujoco_parts import MjModel, MujocoState, mujoco

MOST_DEPTH = 0.03
"""Metres; see `CStep.comparable`."""


class ControlStep(NamedTuple):
    """What a control step of a task is to C MuJoCo."""

    model: MjModel
    substeps: int
    physics: Callable[[Any], MujocoState]
    """Function from a state of the task to that of the model."""
    ctrl: Callable[[Any], Any]
    """Function from an action [A] to the controls [nu]."""


class CStep(NamedTuple):
    """One control step of many states in C MuJoCo, float64."""

    qpos: np.ndarray
    qvel: np.ndarray
    contacts: np.ndarray
    """[N] most contacts in one of the substeps."""
    deepest: np.ndarray
    """[N] greatest depth of a contact in one of the substeps, in metres."""
    is_valid: np.ndarray
    """[N] whether C MuJoCo has not found the step unstable. It starts again from `qpos0` then; MJX does not."""

    def comparable(self) -> np.ndarray:
        """[N] whether the step is a truth to compare with: stable, and no contact as deep as only bodies that have gone
        through each other have, where the axes of capsules cross and the direction of the force is arbitrary."""
        return self.is_valid & (self.deepest < MOST_DEPTH)


def c_step(model: MjModel, substeps: int, states: MujocoState, ctrl: np.ndarray) -> CStep:
    """One control step of each state [N] with controls [N, nu] in C MuJoCo."""
    data, rows = mujoco.MjData(model), []
    for qpos, qvel, act, warmstart, time, u in zip(*states, ctrl, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.act[:], data.qacc_warmstart[:] = qpos, qvel, act, warmstart
        data.time, data.ctrl[:] = time, u
        contacts, deepest = 0, 0.0
        for _ in range(substeps):
            mujoco.mj_step(model, data)
            contacts = max(contacts, data.ncon)
            deepest = max(deepest, *(-contact.dist for contact in data.contact)) if data.ncon else deepest
        is_valid = not any(warning.number for warning in data.warning)
        rows.append((data.qpos.copy(), data.qvel.copy(), contacts, deepest, is_valid))
    return CStep(*(np.array(part) for part in zip(*rows, strict=True)))


def relative_error(of: np.ndarray, to: np.ndarray) -> np.ndarray:
    """[N] greatest error of a row, divided by the greatest entry of the right row, or by 1 if that is greater."""
    return np.abs(of - to).max(axis=1) / np.maximum(np.abs(to).max(axis=1), 1.0)


def quantiles(errors: np.ndarray) -> dict[str, Any]:
    """Number, median, 99 % and greatest of errors; NaN if there are none."""
    values = [float(np.quantile(errors, q)) if len(errors) else float("nan") for q in (0.5, 0.99, 1.0)]
    return dict(zip(("states", "median", "p99", "max"), (len(errors), *values), strict=True))


def one_ulp(states: MujocoState, seed: int = 0) -> MujocoState:
    """The states with positions and velocities moved by one float32 ulp, up or down at random."""
    rng = np.random.default_rng(seed)

    def moved(array: np.ndarray) -> np.ndarray:
        return np.nextafter(array, np.where(rng.random(array.shape) < 0.5, np.inf, -np.inf).astype(np.float32))

    return states._replace(qpos=moved(states.qpos), qvel=moved(states.qvel))
