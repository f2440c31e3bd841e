"""MuJoCo by simd and by xla, both MJX in float32, against C MuJoCo itself in float64.

A state that moves by one float32 ulp shows how exact a comparison can be: C MuJoCo's own answer moves, too. All models
have C MuJoCo's own settings of the solver here, with which it converges; otherwise its answer is no truth to compare
with.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import numpy as np
import pytest

from tests import mujoco_models as models
from tests.mujoco_models import Example, c_states, c_step, one_ulp, random_ctrl
from workers.environments import mujoco_parts
from workers.environments.mujoco_parts import MjModel, MujocoState, mujoco
from workers.simd.episodes.kernel import compile_kernel

pytestmark = pytest.mark.slow
DISABLED = mujoco.mjtDisableBit
ULPS = 4
"""Times that the states are moved by one ulp."""
TIMES = 8.0
"""Errors may be so many times as great as what one ulp of a state makes in C MuJoCo: a step rounds thousands of times.
The swimmer's, whose links weigh 10 g, are greater."""
MODELS = {
    "brax:ant": models.brax_ant,
    **{f"playground:{name}": (lambda of=name: models.of_playground(of)) for name in models.OF_PLAYGROUND},
    **{
        f"gymnasium:{name}": (lambda of=name: models.of_gymnasium(of))
        for name in models.OF_GYMNASIUM
        if name != "humanoid"  # 138 contacts: minutes to compile by xla
    },
}


class Sides:
    """A control step of a model, and the forces of contacts, by simd and by xla."""

    def __init__(self, example: Example) -> None:
        self.model, self.substeps = models.as_c(example.model), example.substeps
        self.mx = mujoco_parts.put_model(self.model, all_pairs=True)  # as C MuJoCo
        self.given = mujoco_parts.start(self.mx), np.zeros(self.model.nu, np.float32)

    def step(self, state: MujocoState, ctrl: Any) -> MujocoState:
        return mujoco_parts.step(self.mx, state, ctrl, self.substeps)

    def forces(self, state: MujocoState, ctrl: Any) -> tuple[Any, Any]:
        """Forces of the contacts, and their geoms."""
        data: Any = mujoco_parts.forward(self.mx, state, ctrl)
        return mujoco_parts.contact_forces(self.mx, data), data._impl.contact.geom

    def simd(self, function: Callable[..., Any]) -> Callable[..., Any]:
        return compile_kernel(function, *self.given)

    def xla(self, function: Callable[..., Any]) -> Callable[..., Any]:
        compiled = jax.jit(jax.vmap(function))
        return lambda *given: jax.tree.map(np.asarray, compiled(*given))


@cache
def sides(name: str) -> Sides:
    example = MODELS[name]()
    if example is None:
        pytest.skip("the files of playground 0.2.0 are not there")
    return Sides(example)


def compare(of: Sides, count: int, *others: str) -> dict[tuple[str, str], np.ndarray]:
    """Errors of positions and velocities after a control step from each comparable state, by (side, field)."""
    states, ctrl = c_states(of.model, of.substeps, count), random_ctrl(of.model, count, np.random.default_rng(1))
    truth = c_step(of.model, of.substeps, states, ctrl)
    moved = [c_step(of.model, of.substeps, one_ulp(states, seed), ctrl) for seed in range(ULPS)]
    found = {side: getattr(of, side)(of.step)(states, ctrl) for side in ("simd", *others)}
    use = truth.comparable()
    print(f"\n{count} states, {int((truth.contacts > 0).sum())} in contact; {int((~use).sum())} are left out")
    errors = {}
    for field in ("qpos", "qvel"):
        right = getattr(truth, field)[use]
        by_ulp = [models.relative_error(getattr(m, field)[use], right) for m in moved]
        errors["C, one ulp", field] = np.maximum.reduce(by_ulp)
        for side, state in found.items():
            errors[side, field] = models.relative_error(getattr(state, field)[use], right)
    for key, error in errors.items():
        quantiles = {what: f"{value:.1e}" for what, value in models.quantiles(error).items()}
        print(*key, {what: quantiles[what] for what in ("median", "p99", "max")})
    return errors


def c_forces(of: Sides, states: MujocoState, ctrl: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """[N, pair, 3] force of the first geom of each pair on the second, world frame, in C MuJoCo."""
    data, frame_force = mujoco.MjData(of.model), np.zeros(6)
    forces = np.zeros((len(ctrl), len(pairs), 3))
    for number, (qpos, qvel, act, warmstart, _, u) in enumerate(zip(*states, ctrl, strict=True)):
        data.qpos[:], data.qvel[:], data.act[:], data.qacc_warmstart[:], data.ctrl[:] = qpos, qvel, act, warmstart, u
        mujoco.mj_forward(of.model, data)
        for at, contact in enumerate(data.contact):
            mujoco.mj_contactForce(of.model, data, at, frame_force)
            (pair,) = np.flatnonzero((pairs == np.sort(contact.geom)).all(axis=1))
            forces[number, pair] += contact.frame.reshape(3, 3).T @ frame_force[:3]
    return forces


def force_errors(of: Sides, count: int, *others: str) -> dict[str, np.ndarray]:
    """Greatest error of the force between two geoms in each comparable state, divided by the greatest force in it, by
    side."""
    states, ctrl = (
        c_states(of.model, of.substeps, count, seed=2),
        random_ctrl(of.model, count, np.random.default_rng(2)),
    )
    found = {side: getattr(of, side)(of.forces)(states, ctrl) for side in ("simd", *others)}
    contact_pairs = np.sort(found["simd"][1][0], axis=1)
    pairs = np.unique(contact_pairs, axis=0)
    sums = (contact_pairs == pairs[:, None]).all(axis=2).astype(float)  # [pair, contact]
    truth = c_forces(of, states, ctrl, pairs)
    comparable = c_step(of.model, of.substeps, states, ctrl).comparable()
    touching = (np.abs(truth).max(axis=(1, 2)) > 0) & comparable
    assert touching.mean() > 0.1

    def error(forces: np.ndarray) -> np.ndarray:
        return models.relative_error(*(of[touching].reshape(touching.sum(), -1) for of in (forces, truth)))

    errors = {side: error(sums @ forces) for side, (forces, _) in found.items()}
    moved = [error(c_forces(of, one_ulp(states, seed), ctrl, pairs)) for seed in range(ULPS)]
    errors["C, one ulp"] = np.maximum.reduce(moved)
    for side, of_side in errors.items():
        print(side, "contact forces", {what: f"{value:.1e}" for what, value in models.quantiles(of_side).items()})
    return errors


def check(errors: dict[Any, np.ndarray], times: float) -> None:
    """99 % of the errors are at most so many times the greatest that one ulp makes in C MuJoCo, with its unit 1e-6."""
    for key, error in errors.items():
        ulp = errors["C, one ulp" if isinstance(key, str) else ("C, one ulp", key[1])]
        assert np.quantile(error, 0.99) <= times * (ulp.max() + 1e-6), key


def test_a_control_step_of_the_ant_is_that_of_c_mujoco():
    check(compare(sides("brax:ant"), 128), TIMES)


def test_contact_forces_of_the_ant_are_those_of_c_mujoco():
    check(force_errors(sides("brax:ant"), 128), TIMES)


@pytest.mark.long
@pytest.mark.parametrize("name", MODELS)
def test_a_control_step_is_that_of_c_mujoco(name: str):
    """Of 1,000 states, by simd and by xla."""
    errors = compare(sides(name), 1000, "xla")
    check(errors, 40.0 if name == "playground:swimmer" else TIMES)
    for field in ("qpos", "qvel"):
        ours, theirs = (np.quantile(errors[side, field], 0.99) for side in ("simd", "xla"))
        assert ours <= 2.0 * theirs + 1e-6


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name in MODELS if not name.endswith(("cartpole", "reacher", "swimmer"))])
def test_contact_forces_are_those_of_c_mujoco(name: str):
    check(force_errors(sides(name), 1000, "xla"), TIMES)


def free_ant(integrator: int, gravity: bool) -> MjModel:
    """Brax's ant with nothing that adds or takes energy: no contacts, limits or damping, and perhaps no gravity."""
    model = models.brax_ant().model
    for flag in (DISABLED.mjDSBL_CONTACT, DISABLED.mjDSBL_LIMIT, DISABLED.mjDSBL_DAMPER, DISABLED.mjDSBL_ACTUATION):
        model.opt.disableflags |= flag
    model.opt.integrator, model.opt.timestep = integrator, 0.002
    if not gravity:
        model.opt.disableflags |= DISABLED.mjDSBL_GRAVITY
    return model


def conserved(model: MjModel, states: MujocoState) -> np.ndarray:
    """[N, 7] energy in joules, momentum and angular momentum about the centre of mass of states [N], in float64."""
    model, rows = copy.copy(model), []
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data = mujoco.MjData(model)
    for qpos, qvel in zip(states.qpos, states.qvel, strict=True):
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        momentum = data.subtree_linvel[0] * model.body_subtreemass[0]
        rows.append([data.energy.sum(), *momentum, *data.subtree_angmom[0]])
    return np.array(rows)


def drifts(model: MjModel, steps: int, lanes: int) -> tuple[np.ndarray, np.ndarray]:
    """How far what is conserved has drifted, [7] each: by simd, and in C MuJoCo with states rounded to float32."""
    mx = mujoco_parts.put_model(model)
    start = mujoco_parts.start(mx)
    kernel = compile_kernel(lambda state: mujoco_parts.step(mx, state, np.zeros(model.nu), 10), start)
    rng = np.random.default_rng(0)
    states: MujocoState = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], lanes, axis=0), start)
    states = states._replace(qvel=rng.normal(0.0, 1.0, states.qvel.shape).astype(np.float32))
    ours, theirs, data = states, jax.tree.map(np.copy, states), mujoco.MjData(model)
    for _ in range(steps // 10):
        ours = kernel(ours)
    for qpos, qvel in zip(theirs.qpos, theirs.qvel, strict=True):
        data.qpos[:], data.qvel[:] = qpos, qvel
        for _ in range(steps):
            mujoco.mj_step(model, data)
            data.qpos[:], data.qvel[:] = data.qpos.astype(np.float32), data.qvel.astype(np.float32)
        qpos[:], qvel[:] = data.qpos, data.qvel
    before = conserved(model, states)
    drift = [np.abs(conserved(model, after) - before).max(axis=0) for after in (ours, theirs)]
    print(
        "\ndrift of energy, momentum, angular momentum:", *(f"{side:.1e}" for side in drift[0]), "C, float32:", drift[1]
    )
    return drift[0], drift[1]


@pytest.mark.long
@pytest.mark.parametrize("integrator", [mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_RK4])
def test_energy_drifts_no_more_than_in_c_mujoco_with_float32_states(integrator: int):
    ours, theirs = drifts(free_ant(integrator, gravity=True), 1000, 8)
    assert ours[0] <= 1.5 * theirs[0] + 1e-4


@pytest.mark.long
def test_momentum_drifts_no_more_than_in_c_mujoco_with_float32_states():
    ours, theirs = drifts(free_ant(mujoco.mjtIntegrator.mjINT_RK4, gravity=False), 1000, 8)
    assert (ours[1:] <= 1.5 * theirs[1:] + 1e-4).all()


def test_an_ant_at_rest_stays_at_rest():
    """1,000 control steps without action, after C MuJoCo has let it settle."""
    of = sides("brax:ant")
    data = mujoco.MjData(of.model)
    data.qpos[:] = models.first_qpos(of.model)
    mujoco.mj_step(of.model, data, 5000)
    assert np.abs(data.qvel).max() < 1e-6
    assert data.ncon == 4
    state = mujoco_parts.start(of.mx, data.qpos, data.qvel)._replace(warmstart=np.float32(data.qacc_warmstart))
    state = jax.tree.map(lambda leaf: np.asarray(leaf)[None], state)
    kernel, ctrl = of.simd(of.step), np.zeros((1, of.model.nu), np.float32)
    fastest = 0.0
    for _ in range(1000):
        state = kernel(state, ctrl)
        fastest = max(fastest, float(np.abs(state.qvel).max()))
    print("\ngreatest velocity", fastest, "moved by", np.abs(state.qpos[0] - data.qpos).max())
    assert fastest < 1e-3
    assert np.abs(state.qpos[0] - data.qpos).max() < 1e-3
