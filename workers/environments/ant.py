"""AntMaze, AntTrap and their ant: Brax's ant in its `spring` pipeline, with walls and a torso that touches the floor.

A substep is Brax's own `brax.spring.pipeline.step`, to which contacts with walls are added and whose contact impulses
are recorded. A control step has ten substeps. The state between control steps is small: positions and velocities of the
links, and the sum of the contact impulses. `ant_mujoco.py` has the ant in MuJoCo's physics, with the same functions.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
from etils import epath

from es_service.protocol.noise import uniforms
from workers.environments import SHIPPED, Environment
from workers.environments.ant_tasks import (
    BODIES,
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
    WALL_RADIUS,
)
from workers.environments.brax_task import (
    Contact,
    Motion,
    State,
    System,
    Transform,
    brax_contact,
    collisions,
    com,
    kinematics,
    load,
    pipeline,
    quietly,
)
from workers.environments.walls import Segment, WallRows, nearest_wall, wall_rows, walls_near
from workers.viewer import Viewer

SUBSTEPS = 10
SUBSTEP_S = STEP_S / SUBSTEPS
TORSO_RADIUS, LEG_RADIUS = 0.25, 0.08
LEG_LENGTH = 0.4
"""Extent of a lower leg along x and along y in its own frame, in metres."""
LOWER_LEGS = ((2, 1, 1), (4, -1, 1), (6, -1, -1), (8, 1, -1))
"""(link, sign of x, sign of y) of the lower legs in Gym's order: front left, front right, back left, back right."""
TORSO = 0
BODY_OF_LINK = {TORSO: 1, **{link: 4 + 3 * leg for leg, (link, _, _) in enumerate(LOWER_LEGS)}}
"""Number of the body of Gym's ant for each link that can touch something."""


class AntState(NamedTuple):
    """State of one ant between two control steps. There are L = 9 links: the torso, then (upper, lower) of each leg."""

    centre: Transform
    """[L] centres of mass in the world frame."""
    motion: Motion
    """[L] velocities of the centres of mass."""
    q: Any
    """[15] torso position, torso quaternion, joint angles."""
    qd: Any
    """[14] velocities of the torso and of the joints."""
    push: Motion
    """[L] sum of the contact impulses of the last control step divided by its duration: torque about the centre of mass
    and force, in the world frame. Masses and inertias are 1, so an impulse is a change of velocity."""


class Ant(NamedTuple):
    """Functions of the state of one ant among walls. States have `q` [15] and `qd` [14], as of an `AntState`."""

    reset: Callable[[Any, tuple[float, float]], Any]
    """Function (stream key, start xy) -> state."""
    step: Callable[[Any, Any], Any]
    """Function (state, action [8]) -> state one control step later; actions are clipped to [-1, 1]."""
    viewer: Viewer
    contact_forces: Callable[[Any], Any]
    """Function from a state to torque and force on each of 14 bodies [84], in Gym's order, clipped."""
    system: System | None = None
    """Brax's system; None in MuJoCo's physics."""


def ant_in(physics: str, walls: tuple[Segment, ...], at_once: Sequence[int]) -> Ant:
    """The ant of a task in the physics that its option names: `spring`, `mujoco` with the integrator RK4 of `ant.xml`,
    or `mujoco_euler`, which takes a quarter of the time.

    Args:
        at_once: contacts that are solved at once in MuJoCo's physics, for an ant that lies on its back, too; see
            `mujoco_contacts.solve`. They have no influence but on the speed, and by rounding.

    Raises:
        TaskError: what the physics needs is not installed.
    """
    if physics == "spring":
        return make_ant(walls)
    from workers.environments import ant_mujoco

    return ant_mujoco.make_ant(walls, "RK4" if physics == "mujoco" else "Euler", at_once)


def make_ant(walls: tuple[Segment, ...] = (), near: int | None = None) -> Ant:
    """Build the ant of a task. The model shows the walls to viewers only; `walls.py` computes contacts with them.

    Args:
        near: how many walls an ant can meet in a control step, if they are far fewer than all of them: those nearest to
            its torso when the control step begins. None: all are looked at.
    """
    system, rows = load_system(walls), wall_rows(walls) if walls else None

    def reset(key: Any, start: tuple[float, float]) -> AntState:
        u = joint_noise(key)
        q = system.init_q.at[7:].add(u[:JOINTS]).at[:2].set(jnp.array(start, jnp.float32))
        qd = jnp.zeros(6 + JOINTS, jnp.float32).at[6:].set(u[JOINTS:])
        state = pipeline.init(system, q, qd)
        return AntState(state.x_i, state.xd_i, q, qd, Motion.zero((system.num_links(),)))

    def step(state: AntState, action: Any) -> AntState:
        met = rows if rows is None or near is None else walls_near(rows, state.q[:2], near)

        def substep(_, carry):
            physics, push = carry
            physics, impulse = physics_step(system, physics, action, met)
            return physics, push + impulse

        none = Motion.zero((system.num_links(),))
        physics, push = jax.lax.fori_loop(0, SUBSTEPS, substep, (expand(system, state), none))
        return AntState(physics.x_i, physics.xd_i, physics.q, physics.qd, push / STEP_S)

    return Ant(reset, step, ant_viewer(system), contact_forces, system)


def joint_noise(key: Any) -> Any:
    """Noise of a reset on the angles of the joints, then on their velocities [16]."""
    return (2.0 * uniforms(key, jnp.arange(2 * JOINTS, dtype=jnp.uint32)) - 1.0) * RESET_NOISE


def physics_step(system: System, state: State, action: Any, walls: WallRows | None) -> tuple[State, Motion]:
    """One substep of Brax with walls, if there are any.

    Returns:
        (state, impulse of the contacts on each link [L], about its centre of mass)
    """
    given = []

    def resolve(system: System, state: State) -> Motion:
        with _replaced(collisions, "contact", SimpleNamespace(get=lambda system, x: _contacts(system, x, walls))):
            given.append(brax_resolve(system, state))
        return given[0]

    brax_resolve = collisions.resolve
    with quietly(), _replaced(pipeline, "collisions", SimpleNamespace(resolve=resolve)):
        state = pipeline.step(system, state, action)
    return state, given[0]


def expand(system: System, state: AntState) -> State:
    """Brax's full state of an ant, derived from the small state."""
    x, xd = com.to_world(system, state.centre, state.motion)
    j, jd, a_p, a_c = kinematics.world_to_joint(system, x, xd)
    i_inv = com.inv_inertia(system, x)
    mass = system.link.inertia.mass ** (1 - system.spring_mass_scale)
    return State(
        q=state.q, qd=state.qd, x=x, xd=xd, contact=None, x_i=state.centre, xd_i=state.motion,
        j=j, jd=jd, a_p=a_p, a_c=a_c, i_inv=i_inv, mass=mass,
    )  # fmt: skip


def observe(state: Any) -> Any:
    """Gym's observation [27] of a state of any physics: torso height and quaternion, joint angles, all velocities."""
    return jnp.concatenate([state.q[2:], state.qd])


def ant_viewer(system: System) -> Viewer:
    return Viewer(system.mj_model, lambda state: com.to_world(system, state.centre, state.motion)[0], STEP_S)


def contact_forces(state: AntState) -> Any:
    """Gym's contact forces [84]: torque and force on each of 14 bodies, clipped to [-1, 1].

    They are zero for bodies that touch nothing.
    """
    zero_6 = jnp.zeros(6, jnp.float32)
    by_body = dict.fromkeys(range(BODIES), zero_6)
    for link, body in BODY_OF_LINK.items():
        by_body[body] = jnp.concatenate([state.push.ang[link], state.push.vel[link]])
    return jnp.clip(jnp.concatenate(list(by_body.values())), -FORCE_LIMIT, FORCE_LIMIT)


def load_system(walls: tuple[Segment, ...]) -> System:
    """Brax's system of its ant.xml with a torso that touches the floor, and with walls that have no contacts."""
    elem = ElementTree.fromstring((epath.resource_path("brax") / "envs" / "assets" / "ant.xml").read_text())
    torso = elem.find(".//geom[@name='torso_geom']")
    world = elem.find("worldbody")
    assert torso is not None
    assert world is not None
    torso.set("contype", "1")
    for number, ((x0, y0), (x1, y1)) in enumerate(walls):
        size = f"{np.hypot(x1 - x0, y1 - y0) / 2 + WALL_RADIUS:g} {WALL_RADIUS:g} 0.5"
        middle, angle = f"{(x0 + x1) / 2:g} {(y0 + y1) / 2:g} 0.5", f"0 0 {np.degrees(np.arctan2(y1 - y0, x1 - x0)):g}"
        shape = {"type": "box", "size": size, "pos": middle, "euler": angle, "rgba": "0.5 0.5 0.55 1"}
        ElementTree.SubElement(world, "geom", {"name": f"wall_{number}", "contype": "0", "conaffinity": "0", **shape})
    system: Any = load(ElementTree.tostring(elem, encoding="unicode"))
    return system.tree_replace({"opt.timestep": SUBSTEP_S})


def _contacts(system: System, x: Transform, walls: WallRows | None) -> Contact:
    """Contacts with the floor, as Brax finds them, followed by one contact with a wall for each collider."""
    floor = brax_contact.get(system, x)
    assert floor is not None
    if walls is None:
        return floor
    feet_3 = [x.pos[TORSO]]
    for link, sign_x, sign_y in LOWER_LEGS:
        end_3 = jnp.array([sign_x * LEG_LENGTH, sign_y * LEG_LENGTH, 0.0])
        feet_3.append(x.take(link).do(Transform.create(pos=end_3)).pos)
    links = [TORSO, *(link for link, _, _ in LOWER_LEGS)]
    knees_3 = [x.pos[link] for link in links]
    radii = jnp.array([TORSO_RADIUS] + [LEG_RADIUS] * len(LOWER_LEGS))
    met = jax.vmap(lambda foot_3, knee_3, radius: nearest_wall(walls, foot_3, knee_3, radius))
    contact = met(jnp.stack(feet_3), jnp.stack(knees_3), radii)
    colliders = len(links)
    frame = jnp.zeros((colliders, 3, 3)).at[:, 0].set(contact.normal_3)  # Brax uses only the normal
    like_floor = jax.tree.map(lambda rows: rows[:colliders], floor.replace(link_idx=None))
    wall = like_floor.replace(
        dist=contact.distance, pos=contact.position_3, frame=frame, elasticity=jnp.zeros(colliders),
        friction=jnp.ones_like(like_floor.friction),
    )  # fmt: skip
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), floor.replace(link_idx=None), wall)
    # As in contacts with the floor, the first of the two bodies is the world, which is link -1 in Brax.
    world, ant = floor.link_idx
    no_link = jnp.full(colliders, -1)
    return both.replace(link_idx=(jnp.concatenate([world, no_link]), jnp.concatenate([ant, jnp.array(links)])))


@contextlib.contextmanager
def _replaced(module: Any, name: str, value: Any) -> Iterator[None]:
    """Context manager that replaces a name of a module while one substep is traced.

    It is used inside of `quietly`, which only one thread can enter at a time.
    """
    before = getattr(module, name)
    setattr(module, name, value)
    try:
        yield
    finally:
        setattr(module, name, before)


# AntMaze: an ant must go round three walls to a goal 60 m away; the direct path ends in a pocket.
#
# The arena, episode length and descriptor are those of the benchmark paper (Chalumeau et al. 2022); the inner walls,
# the start and the goal are those of the original ME-ES task (Colas et al. 2020).

MAZE_WALLS = SHIPPED["ant_maze"].walls or ()
LOW, HIGH = MAZE_BOUNDS
MIDDLE, HALF = (LOW + HIGH) / 2.0, (HIGH - LOW) / 2.0
"""Middle of the arena and half of its side; they scale positions in observations to [-1, 1]."""


def ant_maze(physics: str = "spring") -> Environment:
    """Functions of AntMaze.

    Args:
        physics: see `ant_in`.
    """
    ant = ant_in(physics, MAZE_WALLS, at_once=(5, 8))

    def step(state: Any, action: Any) -> tuple[Any, Any, Any]:
        state = ant.step(state, action)
        return state, -_goal_distance(state), jnp.array(False)

    def reset(key: Any) -> Any:
        return ant.reset(key, MAZE_START)

    return Environment(reset, _observe_maze, step, _place, _goal_distance, _near_goal, ant.viewer)


def _place(state: Any) -> Any:
    return state.q[:2]


def _observe_maze(state: Any) -> Any:
    return jnp.concatenate([(_place(state) - MIDDLE) / HALF, observe(state)])


def _goal_distance(state: Any) -> Any:
    dx, dy = state.q[0] - MAZE_GOAL[0], state.q[1] - MAZE_GOAL[1]
    return jnp.sqrt(dx * dx + dy * dy)


def _near_goal(state: Any, before: Any) -> Any:
    return _goal_distance(state) <= MAZE_NEAR


# AntTrap: an ant is rewarded for running along +x, straight into a trap that is open on the side of the start.
#
# The numbers are those of the benchmark paper (Chalumeau et al. 2022) and of the QDax environment that it used: the
# reward of Gym's ant with contact cost, observations with contact forces, and a trap 5 m wide and deep.

TRAP_WALLS = SHIPPED["ant_trap"].walls or ()
DESCRIPTOR_BOUNDS = SHIPPED["ant_trap"].descriptor_bounds


def ant_trap(physics: str = "spring", contact_forces: str = "computed") -> Environment:
    """Functions of AntTrap.

    Args:
        physics: see `ant_in`.
        contact_forces: `computed`, as in Gym's ant and in the benchmark; or `zero` in observations and in the reward,
            as with mujoco-py and MuJoCo 2, which did not compute them.
    """
    ant = ant_in(physics, TRAP_WALLS, at_once=(4, 8))

    def forces(state: Any) -> Any:
        return ant.contact_forces(state) if contact_forces == "computed" else jnp.zeros(6 * BODIES, jnp.float32)

    def step(state: Any, action: Any) -> tuple[Any, Any, Any]:
        new = ant.step(state, action)
        forward = (new.q[0] - state.q[0]) / STEP_S
        # The cost is that of the clipped action, as the motors apply it: noise beyond the limits has no effect or cost.
        control = TRAP_CONTROL_COST * jnp.sum(jnp.clip(action, -1.0, 1.0) ** 2)
        contact = TRAP_CONTACT_COST * jnp.sum(forces(new) ** 2)
        done = (new.q[2] < TRAP_HEALTHY_Z[0]) | (new.q[2] > TRAP_HEALTHY_Z[1])
        return new, forward + TRAP_SURVIVAL_REWARD - control - contact, done

    def reset(key: Any) -> Any:
        return ant.reset(key, TRAP_START)

    def observe_all(state: Any) -> Any:
        return jnp.concatenate([_scaled_place(state), observe(state), forces(state)])

    return Environment(reset, observe_all, step, _descriptor, _no_goal, _beyond, ant.viewer)


def _scaled_place(state: Any) -> Any:
    (x_low, x_high), (_, y_high) = DESCRIPTOR_BOUNDS
    half = (x_high - x_low) / 2.0
    return jnp.stack([(state.q[0] - x_low - half) / half, state.q[1] / y_high])


def _descriptor(state: Any) -> Any:
    low, high = (jnp.array(side, jnp.float32) for side in zip(*DESCRIPTOR_BOUNDS, strict=True))
    return jnp.clip(state.q[:2], low, high)


def _beyond(state: Any, before: Any) -> Any:
    return before | (state.q[0] > TRAP_BEYOND_X)


def _no_goal(state: Any) -> Any:
    return jnp.float32(jnp.nan)
