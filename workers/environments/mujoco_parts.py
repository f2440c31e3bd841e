"""Models of MuJoCo in JAX (MJX): the small state of a model, its control step, and what MJX lacks.

A model is an `mujoco.MjModel`, whose own options decide: timestep, integrator (Euler with or without `eulerdamp`,
implicitfast, RK4), cone (pyramidal, elliptic), solver (Newton, CG) with its iterations and tolerances. `put_model`
makes MJX's model of it, or refuses it with the names of the elements that MJX lacks. Everything else of MuJoCo is MJX's
own and is used as it is, but for RK4, the contacts of capsules with planes and with cylinders (`contacts_as_c`), and
how contacts are solved (`mujoco_contacts.py`).

Made with mujoco 4.0.0 and mujoco-mjx 3.17.0 (`constraints.txt`); tests compare both with MuJoCo's own code in C
(`tests/workers/test_mujoco_oracles.py`). Another version of MJX may compute something else, and other lines of it may
be what simd cannot compile.
"""

from __future__ import annotations

import copy
import importlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from workers.environments import TaskError
from workers.environments.brax_task import Transform, quietly
from workers.environments.mujoco_contacts import AT_ONCE, contacts_as_c, solve
from workers.viewer import Viewer

mujoco: Any = importlib.import_module("mujoco")  # its module does not say what it contains
with quietly():
    from mujoco import mjx
    from mujoco.mjx._src import collision_driver, sensor, support, types
    from mujoco.mjx._src import forward as forward_of_mjx

MjModel = Any
"""A model of C MuJoCo, `mujoco.MjModel`."""
LIMITS = ("max_contact_points", "max_geom_pairs")
"""Custom numbers (`numeric`) of a model that limit its contacts in MJX: most contacts of each `condim`, the deepest
first, and most pairs of geoms of each two types, the nearest first. C MuJoCo knows none."""


once: Any = partial(jax.jit, inline=True)
"""Decorator: a function that JAX traces once for all that call it, and that leaves no trace of its own in what they
compute. MJX's forward takes seconds to trace, and without this it is traced for each shape, loop and kernel again."""


class MujocoState(NamedTuple):
    """State of a model between two control steps: all that the next one depends on."""

    qpos: Any
    """[nq] positions: metres, radians, unit quaternions (w, x, y, z)."""
    qvel: Any
    """[nv] velocities: metres and radians per second."""
    act: Any
    """[na] activations of the actuators that have one."""
    warmstart: Any
    """[nv] accelerations of the last substep, at which the solver of the constraints may begin."""
    time: Any
    """Seconds since the start."""


def contact_limits(model: MjModel) -> dict[str, int]:
    """The limits of contacts that a model declares, of `LIMITS`; those that it lacks are left out."""
    numbers = {name: mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name) for name in LIMITS}
    return {name: int(model.numeric_data[model.numeric_adr[at]]) for name, at in numbers.items() if at >= 0}


def put_model(model: MjModel, *, all_pairs: bool = False) -> mjx.Model:
    """MJX's model.

    MJX looks for the limits of contacts at a wrong place if a `numeric` of several numbers comes before them, and then
    may compute no contact at all without a word. Here they are where it looks; the other custom numbers of MJX's model
    must not be used.

    Args:
        model: a model, which is not changed.
        all_pairs: whether to compute all contacts, as C MuJoCo does, and not only so many as the model's limits allow.
            With limits, which contacts are computed depends on the state, and what the left out ones would push is
            missing. Three of Playground's models with all pairs run at 0.3 to 0.6 of the speed.

    Raises:
        TaskError: MJX, in which the model would be another one or none, lacks elements of it; the message names each.
    """
    if lacking := list(_lacking(model)):
        raise TaskError(f"MJX lacks parts of this MuJoCo model: {'; '.join(lacking)}")
    limits, model = contact_limits(model), copy.copy(model)
    for name, limit in limits.items():
        at = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name)
        model.numeric_data[at] = -1 if all_pairs else limit  # MJX reads numeric_data[at], not [numeric_adr[at]]
    try:
        with quietly():
            return mjx.put_model(model, impl="jax")
    except NotImplementedError as error:
        raise TaskError(f"MJX lacks parts of this MuJoCo model: {error}") from error


def start(model: mjx.Model, qpos: Any = None, qvel: Any = None) -> MujocoState:
    """State of a model with these positions [nq] and velocities [nv]; those of `qpos0`, and 0, if None."""
    data, dtype = mjx.make_data(model), model.qpos0.dtype
    qpos, qvel = (own if given is None else given for own, given in ((data.qpos, qpos), (data.qvel, qvel)))
    zeros = (data.act, data.qacc_warmstart, data.time)
    return MujocoState(*(jnp.asarray(array, dtype) for array in (qpos, qvel, *zeros)))


def step(model: mjx.Model, state: MujocoState, ctrl: Any, substeps: int = 1) -> MujocoState:
    """State of a model one control step later.

    Args:
        ctrl: [nu] controls, which MuJoCo clips to their ranges, and which are the same in all substeps.
        substeps: steps of `opt.timestep` in a control step.
    """
    return step_and_look(model, state, ctrl, substeps, lambda data: ())[0]


def step_and_look(
    model: mjx.Model,
    state: MujocoState,
    ctrl: Any,
    substeps: int,
    look: Callable[[mjx.Data], Any],
    at_once: Sequence[int] = AT_ONCE,
    contacts: Mapping[Any, Any] = MappingProxyType({}),
) -> tuple[MujocoState, Any]:
    """As `step`, with what a function sees in the data of the last substep.

    As in C MuJoCo, all in the data but `qpos`, `qvel`, `act` and `time` is what the last computation of forces found:
    that of the state before the substep, or with RK4 that of its fourth stage.

    Args:
        look: function from data to a pytree of arrays.
        at_once: numbers of contacts that are solved without all others, as in `mujoco_contacts.solve`. They change the
            speed, and results by rounding.
        contacts: functions that find contacts of two types of geoms, in place of those of MJX.
    """
    integrate = _runge_kutta if model.opt.integrator == types.IntegratorType.RK4 else _single_stage
    forward = once(lambda data: _forward(model, data, at_once))

    def substep(before: tuple[MujocoState, Any], _: None) -> tuple[tuple[MujocoState, Any], None]:
        return integrate(model, _data(mjx.make_data(model), before[0], ctrl), look, forward), None

    with contacts_as_c(contacts):
        first = jax.eval_shape(lambda: substep((state, ()), None)[0][1])
        begun = state, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), first)
        return substep(begun, None)[0] if substeps == 1 else jax.lax.scan(substep, begun, None, length=substeps)[0]


INTEGRATORS = {
    types.IntegratorType.EULER: forward_of_mjx.euler,
    types.IntegratorType.IMPLICITFAST: forward_of_mjx.implicit,
}
"""What MJX does after the forces are known, by the integrator; for RK4 see `_runge_kutta`."""


Forward = Callable[[Any], Any]
"""Function from data to data with the forces."""


def _single_stage(
    model: mjx.Model, data: mjx.Data, look: Callable[[mjx.Data], Any], forward: Forward
) -> tuple[MujocoState, Any]:
    """A substep of an integrator that computes forces once, and what is seen in it."""
    found = forward(data)
    after = INTEGRATORS[model.opt.integrator](model, found)
    return _state(after), look(found.replace(qpos=after.qpos, qvel=after.qvel, act=after.act, time=after.time))


def _runge_kutta(
    model: mjx.Model, data: mjx.Data, look: Callable[[mjx.Data], Any], forward: Forward
) -> tuple[MujocoState, Any]:
    """A substep of RK4, and what is seen in its fourth stage.

    It is MJX's with the stages in a loop, since four copies of the physics take four times as long to compile, and with
    the rates of rotations of C MuJoCo.
    """
    advanced = forward_of_mjx._advance

    def moved(rates: tuple[Any, Any, Any], share: Any) -> mjx.Data:
        """Data with the state after a share of a step with these rates of (qpos, qvel, act)."""
        qvel, qacc, act_dot = jax.tree.map(lambda rate: share * rate, rates)
        return advanced(model, data, act_dot, qacc, qvel)

    def stage(number: Any, carry: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
        """Rates of the state that is a share of a step away by the rates of the stage before."""
        rates, sums, _ = carry
        is_inner = (number == 1) | (number == 2)
        share = jnp.where(number == 0, 0.0, jnp.where(is_inner, 0.5, 1.0))
        weight = jnp.where(is_inner, 1.0 / 3.0, 1.0 / 6.0)
        # Only the whole step follows the exponential of an activation and clips it, in C MuJoCo, too.
        at = moved(rates, share).replace(act=data.act + share * model.opt.timestep * rates[2])
        found = forward(at.replace(qacc_warmstart=data.qacc_warmstart))
        turned = _turning(model, share * model.opt.timestep * rates[0], found.qvel)
        rates = turned, found.qacc, found.act_dot
        sums = jax.tree.map(lambda total, rate: total + weight * rate, sums, rates)
        return rates, sums, (found.qacc, look(found))

    still = jax.tree.map(jnp.zeros_like, (data.qvel, data.qacc, data.act_dot))
    shapes = jax.eval_shape(lambda: stage(0, (still, still, None))[2])
    unseen = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    _, rates, (qacc, seen) = jax.lax.fori_loop(0, 4, stage, (still, still, unseen))
    return _state(moved(rates, 1.0).replace(qacc_warmstart=qacc)), seen


def _turning(model: mjx.Model, moved: Any, qvel: Any) -> Any:
    """Rates of the rotation vectors of balls and free bodies that turn with `qvel`, and `qvel` of all else.

    Args:
        moved: [nv] how far a state is from the one before the step; of rotations the vector.
    """
    for joint in range(model.njnt):
        kind, first = model.jnt_type[joint], model.jnt_dofadr[joint]
        if kind in (types.JointType.FREE, types.JointType.BALL):
            at = slice(first + 3, first + 6) if kind == types.JointType.FREE else slice(first, first + 3)
            turn, speed = moved[at], qvel[at]
            angle = jnp.sqrt(jnp.sum(turn**2))
            half = 0.5 * jnp.maximum(angle, 0.3)
            small = 1 / 12 + angle**2 / 720 + angle**4 / 30240
            factor = jnp.where(angle > 0.3, (1.0 - half / jnp.tan(half)) / (4.0 * half**2), small)
            across = jnp.cross(turn, speed)
            qvel = qvel.at[at].set(speed + 0.5 * across + factor * jnp.cross(turn, across))
    return qvel


def forward(
    model: mjx.Model,
    state: MujocoState,
    ctrl: Any,
    contacts: Mapping[Any, Any] = MappingProxyType({}),
    *,
    solved: bool = True,
) -> mjx.Data:
    """What a state and controls [nu] imply, as `mujoco.mj_forward`: positions of bodies, contacts, forces, sensors.

    Args:
        contacts: as of `step_and_look`.
        solved: whether to solve the constraints, which is most of the code. Data that are not solved have None in place
            of the accelerations `qacc` and of the constraints' forces `qfrc_constraint`.
    """
    with contacts_as_c(contacts):
        data = _data(mjx.make_data(model), state, ctrl)
        if solved:
            return _forward(model, data, AT_ONCE)
        return _unsolved(model, data).replace(qacc=None, qfrc_constraint=None)


def _unsolved(model: mjx.Model, data: Any) -> Any:
    """`mjx.forward` until it solves the constraints."""
    data = sensor.sensor_pos(model, forward_of_mjx.fwd_position(model, data))
    data = sensor.sensor_vel(model, forward_of_mjx.fwd_velocity(model, data))
    return forward_of_mjx.fwd_acceleration(model, forward_of_mjx.fwd_actuation(model, data))


def _forward(model: mjx.Model, data: Any, at_once: Sequence[int]) -> Any:
    """`mjx.forward` with the constraints solved by `mujoco_contacts.solve`, whose argument `at_once` is."""
    data = _unsolved(model, data)
    if not data._impl.efc_J.size:
        return sensor.sensor_acc(model, data.replace(qacc=data.qacc_smooth))
    return sensor.sensor_acc(model, solve(model, data, at_once))


def mujoco_viewer(model: MjModel, mx: mjx.Model, step_s: float, physics: Callable[[Any], MujocoState]) -> Viewer:
    """Data for replays of a task with a model.

    Args:
        mx: MJX's model.
        step_s: seconds of a control step.
        physics: function from a state of the task to that of the model.
    """

    def poses(state: Any) -> Transform:
        data: Any = mjx.kinematics(mx, _data(mjx.make_data(mx), physics(state), jnp.zeros(model.nu)))
        return Transform(data.xpos[1:], data.xquat[1:])

    return Viewer(model, poses, step_s)


def contact_forces(model: mjx.Model, data: Any) -> Any:
    """[contacts, 3] forces of the first geom of each contact on the second in the world frame, in newtons.

    The contacts are those of `data._impl.contact`. A pair of geoms that do not touch has contacts of force 0.
    """
    contacts = range(len(data._impl.contact.dim))
    forces = [support.contact_force(model, data, contact, to_world_frame=True)[:3] for contact in contacts]
    return jnp.stack(forces) if forces else jnp.zeros((0, 3))


def _data(empty: mjx.Data, state: MujocoState, ctrl: Any) -> mjx.Data:
    qpos, qvel, act, warmstart, time = state
    return empty.replace(qpos=qpos, qvel=qvel, act=act, qacc_warmstart=warmstart, time=time, ctrl=ctrl)


def _state(data: Any) -> MujocoState:
    return MujocoState(data.qpos, data.qvel, data.act, data.qacc_warmstart, data.time)


_ELEMENTS = (
    ("actuator", "mjOBJ_ACTUATOR", "actuator_trntype", types.TrnType, mujoco.mjtTrn, "transmission"),
    ("actuator", "mjOBJ_ACTUATOR", "actuator_dyntype", types.DynType, mujoco.mjtDyn, "dynamics"),
    ("actuator", "mjOBJ_ACTUATOR", "actuator_gaintype", types.GainType, mujoco.mjtGain, "gain"),
    ("actuator", "mjOBJ_ACTUATOR", "actuator_biastype", types.BiasType, mujoco.mjtBias, "bias"),
    ("equality", "mjOBJ_EQUALITY", "eq_type", types.EqType, mujoco.mjtEq, "type"),
    ("sensor", "mjOBJ_SENSOR", "sensor_type", types.SensorType, mujoco.mjtSensor, "type"),
)
"""(word for an element, its kind, array of the model, what MJX has of it, what C MuJoCo has, word for it)."""
_OPTIONS = (
    ("integrator", {types.IntegratorType.EULER, types.IntegratorType.RK4, types.IntegratorType.IMPLICITFAST},
     mujoco.mjtIntegrator),
    ("solver", types.SolverType, mujoco.mjtSolver),
    ("cone", types.ConeType, mujoco.mjtCone),
)  # fmt: skip
"""(option, what MJX has of it, what C MuJoCo has). MJX's own list of integrators has one that its step lacks."""


_NEWER = (
    *(("joint", "mjOBJ_JOINT", f"jnt_{name}") for name in ("stiffnesspoly", "springyield")),
    ("joint", "mjOBJ_JOINT", "dof_dampingpoly"),
    *(("tendon", "mjOBJ_TENDON", f"tendon_{name}") for name in ("stiffnesspoly", "dampingpoly", "springyield")),
    *(("actuator", "mjOBJ_ACTUATOR", f"actuator_{name}") for name in ("damping", "dampingpoly", "armature")),
    *(("geom", "mjOBJ_GEOM", f"geom_{name}") for name in ("surfacevel", "adhesion")),
    ("pair", "mjOBJ_PAIR", "pair_adhesion"),
    ("sensor", "mjOBJ_SENSOR", "sensor_interval"),
)
"""(word for an element, its kind, array of the model), of MuJoCo 4: MJX takes it for 0 without a word."""


def _word(value: Any) -> str:
    """The last part of the name of a constant of MuJoCo, as in XML."""
    return value.name.rpartition("_")[2].lower()


def _lacking(model: MjModel) -> Iterator[str]:
    """Elements of a model that MJX refuses or leaves out, in words."""

    def named(word: str, kind: str, at: int) -> str:
        return f"{word} {mujoco.mj_id2name(model, getattr(mujoco.mjtObj, kind), at) or at!r}"

    option = model.opt
    for name, has, of_c in _OPTIONS:
        if (value := getattr(option, name)) not in {*has}:
            choices = " or ".join(sorted(_word(of_c(int(one))) for one in has))
            yield f"option {name} = {_word(of_c(value))}; must be {choices}"
    if option.noslip_iterations:
        yield f"option noslip_iterations = {option.noslip_iterations}; must be 0"
    has_fluid = option.density > 0 or option.viscosity > 0 or option.wind.any()
    if has_fluid and option.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST:
        yield "options density, viscosity and wind with the integrator implicitfast; must be Euler or RK4"
    for bit in range(mujoco.mjtEnableBit.mjNENABLE):
        if option.enableflags & 1 << bit and 1 << bit != mujoco.mjtEnableBit.mjENBL_INVDISCRETE:
            yield f"flag {_word(mujoco.mjtEnableBit(1 << bit))} = enable"
    for word, kind, array, has, of_c, part in _ELEMENTS:
        for at, value in enumerate(getattr(model, array)):
            if value not in {*has}:
                yield f"{named(word, kind, at)} ({part} {_word(of_c(value))})"
    for at, group in enumerate(model.actuator_group):
        if option.disableactuator & 1 << max(int(group), 0):
            yield f"{named('actuator', 'mjOBJ_ACTUATOR', at)} (disabled by its group {group})"
    for word, kind in (("actuator", "mjOBJ_ACTUATOR"), ("sensor", "mjOBJ_SENSOR")):
        for at in np.flatnonzero(getattr(model, f"{word}_history")[:, 0]):
            yield f"{named(word, kind, int(at))} (delay)"
    for word, kind, array in _NEWER:
        values = np.asarray(getattr(model, array, ()))
        for at in np.flatnonzero(values.reshape(len(values), -1).any(axis=1)) if values.size else ():
            at = model.dof_jntid[at] if array.startswith("dof") else at
            yield f"{named(word, kind, int(at))} ({array.partition('_')[2]})"
    for at in np.flatnonzero(model.geom_fluid.reshape(model.ngeom, -1)[:, :1]) if has_fluid else ():
        yield f"{named('geom', 'mjOBJ_GEOM', int(at))} (fluidshape ellipsoid)"
    for at in range(model.nflex):
        yield named("flex", "mjOBJ_FLEX", at)
    for at in range(model.nplugin):
        yield named("plugin", "mjOBJ_PLUGIN", at)
    if not option.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT:
        for first, second, _ in collision_driver.geom_pairs(model):
            kinds = model.geom_type[[first, second]]
            if not collision_driver.has_collision_fn(*kinds):
                each = [f"{named('geom', 'mjOBJ_GEOM', int(at))} ({_word(mujoco.mjtGeom(kind))})"
                        for at, kind in zip((first, second), kinds, strict=True)]  # fmt: skip
                yield f"collisions of {' with '.join(each)}"
