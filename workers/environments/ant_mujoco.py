"""The ant of AntMaze and AntTrap in MuJoCo's physics, by MJX: `task.options.physics: mujoco` or `mujoco_euler`.

The model is that of `ant_model.py`, which C MuJoCo steps in `gymnasium:es_service/AntMazeMujoco-v0` and
`AntTrapMujoco-v0`. An episode begins as with Brax's springs, with the same positions and velocities of the joints.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from es_service.protocol.messages import Segment
from workers.environments.ant import Ant, joint_noise
from workers.environments.ant_model import SUBSTEPS, ant_model, boxes_of, compiled, first_qpos
from workers.environments.ant_tasks import FORCE_LIMIT, JOINTS, STEP_S
from workers.environments.mujoco_parts import MujocoState, mjx, mujoco, mujoco_viewer, put_model, start, step_and_look
from workers.environments.wall_boxes import SLOTS, wall_contacts


class MujocoAntState(NamedTuple):
    """State of one ant between two control steps."""

    physics: MujocoState
    force: Any
    """[14, 6] torque and force of the contacts on each body, as C MuJoCo's `cfrc_ext`: about the ant's centre of mass,
    along the axes of the world, in the last computation of forces in the control step. 0 after a reset."""

    @property
    def q(self) -> Any:
        """[15] torso position, torso quaternion, joint angles."""
        return self.physics.qpos

    @property
    def qd(self) -> Any:
        """[14] velocities of the torso and of the joints."""
        return self.physics.qvel


def make_ant(walls: tuple[Segment, ...] = (), integrator: str = "RK4") -> Ant:
    """Build the ant of a task.

    Args:
        integrator: that of the model, `RK4`, or `Euler`.

    Raises:
        TaskError: the package gymnasium, which has the ant's model, is not installed.
    """
    box_W_4 = boxes_of(walls)
    model = compiled(box_W_4[:SLOTS])
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    mx, contacts, init_q = put_model(model), wall_contacts(box_W_4) if walls else {}, first_qpos(model)

    def reset(key: Any, at: tuple[float, float]) -> MujocoAntState:
        noise = joint_noise(key)
        q = jnp.asarray(init_q, jnp.float32).at[7:].add(noise[:JOINTS]).at[:2].set(jnp.array(at, jnp.float32))
        qd = jnp.zeros(model.nv, jnp.float32).at[6:].set(noise[JOINTS:])
        return MujocoAntState(start(mx, q, qd), jnp.zeros((model.nbody, 6)))

    def look(data: Any) -> Any:
        found: Any = mjx.rne_postconstraint(mx, data)
        return found._impl.cfrc_ext

    def step(state: MujocoAntState, action: Any) -> MujocoAntState:
        ctrl = jnp.clip(action, -1.0, 1.0)
        return MujocoAntState(*step_and_look(mx, state.physics, ctrl, SUBSTEPS, look, contacts=contacts))

    viewer = mujoco_viewer(ant_model(walls, drawn=True), mx, STEP_S, lambda state: state.physics)
    return Ant(reset, step, viewer, lambda state: jnp.clip(state.force.ravel(), -FORCE_LIMIT, FORCE_LIMIT))
