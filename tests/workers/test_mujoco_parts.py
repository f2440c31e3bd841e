"""Models of MuJoCo in JAX: limits of contacts, what MJX lacks, and small models by simd beside xla."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest

from tests import mujoco_models
from workers.environments import TaskError, mujoco_parts
from workers.environments.mujoco_parts import MjModel, mujoco
from workers.simd.episodes.kernel import compile_kernel
from workers.simd.frontend.tracer import PRIMITIVES
from workers.simd.graph.graph import UnsupportedError

BALLS = """<mujoco>
  <option gravity="0 0 -10" {option}/>
  {custom}
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <site name="s"/>
    <body name="first" pos="0 0 0.1"><freejoint/><geom name="a" size="0.1" mass="1"/></body>
    <body name="second" pos="1 0 0.3"><freejoint/><geom name="b" size="0.3" mass="2"/></body>
    {more}
  </worldbody>
  {after}
</mujoco>"""
AFTER_MANY = """<custom><numeric name="init_qpos" data="0 0 0 0"/><numeric name="max_contact_points" data="2"/>
  <numeric name="max_geom_pairs" data="1"/></custom>"""


EGG, BOX = (
    f'<geom name="{name}" type="{kind}" size=".1 .2 .3" mass="1"/>'
    for name, kind in (("egg", "ellipsoid"), ("box", "box"))
)
PUSH = '<motor name="x" site="s" group="1"/>'


def model_of(option: str = "", custom: str = "", more: str = "", after: str = "") -> MjModel:
    return mujoco.MjModel.from_xml_string(BALLS.format(option=option, custom=custom, more=more, after=after))


def contacts(mx: Any) -> int:
    """Number of contacts that MJX computes."""
    data: Any = mujoco_parts.mjx.make_data(mx)
    return data._impl.ncon


def test_limits_of_contacts_are_those_that_the_model_names():
    """MJX reads them as if each number had one value before it, and then has no contact at all."""
    model = model_of(custom=AFTER_MANY)
    before = model.numeric_data.copy()
    assert mujoco_parts.contact_limits(model) == {"max_contact_points": 2, "max_geom_pairs": 1}
    assert contacts(mujoco_parts.put_model(model)) == 2
    assert contacts(mujoco_parts.put_model(model, all_pairs=True)) == 3  # two on the floor, one between the balls
    np.testing.assert_array_equal(model.numeric_data, before)


@pytest.mark.parametrize("custom", ["", '<custom><numeric name="max_contact_points" data="2"/></custom>'])
def test_limits_that_mjx_reads_right_stay_as_they_are(custom: str):
    model = model_of(custom=custom)
    assert contacts(mujoco_parts.put_model(model)) == (2 if custom else 3)
    assert contacts(mujoco_parts.put_model(model, all_pairs=True)) == 3


def test_a_state_begins_at_rest_or_as_given():
    mx = mujoco_parts.put_model(model_of())
    state = mujoco_parts.start(mx)
    np.testing.assert_allclose(state.qpos, model_of().qpos0)
    assert not np.any(state.qvel)
    assert [leaf.shape for leaf in state] == [(14,), (12,), (0,), (12,), ()]
    assert all(leaf.dtype == np.float32 for leaf in state)
    np.testing.assert_array_equal(mujoco_parts.start(mx, qvel=np.ones(12)).qvel, np.ones(12))


@pytest.mark.parametrize(
    ("parts", "named"),
    [
        ({"option": 'solver="PGS"'}, "option solver = pgs; must be cg or newton"),
        ({"option": 'integrator="implicit"'}, "option integrator = implicit; must be euler or implicitfast or rk4"),
        ({"option": 'integrator="discrete"'}, "option integrator = discrete"),
        ({"option": 'noslip_iterations="3"'}, "option noslip_iterations = 3; must be 0"),
        ({"option": 'density="1" integrator="implicitfast"'}, "with the integrator implicitfast; must be Euler or RK4"),
        ({"after": '<option><flag sleep="enable" energy="enable"/></option>'}, "energy = enable; flag sleep = enable"),
        ({"after": '<actuator><adhesion name="x" body="first" ctrlrange="0 1"/></actuator>'}, "x' (transmission body)"),
        ({"after": '<actuator><general name="x" site="s" dyntype="user"/></actuator>'}, "actuator 'x' (dynamics user)"),
        ({"after": '<actuator><motor name="x" site="s" delay="0.1" nsample="5"/></actuator>'}, "actuator 'x' (delay)"),
        (
            {"option": 'actuatorgroupdisable="1"', "after": f"<actuator>{PUSH}</actuator>"},
            "actuator 'x' (disabled by its group 1)",
        ),
        ({"after": '<sensor><distance name="x" geom1="a" geom2="b"/></sensor>'}, "sensor 'x' (type geomdist)"),
        (
            {"option": 'density="1"', "more": '<geom name="x" size=".1" fluidshape="ellipsoid"/>'},
            "geom 'x' (fluidshape ellipsoid)",
        ),
        (
            {"more": f"<body><freejoint/>{EGG}</body><body><freejoint/>{BOX}</body>"},
            "collisions of geom 'egg' (ellipsoid) with geom 'box' (box)",
        ),
    ],
)  # fmt: skip
def test_what_mjx_lacks_is_refused_by_its_name(parts: dict[str, str], named: str):
    with pytest.raises(TaskError, match=r"^MJX lacks parts of this MuJoCo model: ") as refused:
        mujoco_parts.put_model(model_of(**parts))
    assert named in str(refused.value)


@pytest.mark.slow
def test_what_simd_lacks_is_refused_with_the_line_of_the_user(monkeypatch: pytest.MonkeyPatch):
    """The primitive itself stands in a line of MJX, in which no user can do anything."""
    mx = mujoco_parts.put_model(model_of())
    monkeypatch.delitem(PRIMITIVES, "cholesky")
    with pytest.raises(UnsupportedError, match=r"^the primitive cholesky \(at .*/test_mujoco_parts\.py:[0-9]+ \("):
        compile_kernel(lambda state: mujoco_parts.step(mx, state, np.zeros(0)), mujoco_parts.start(mx))


def sliding_balls(cone: str) -> MjModel:
    """Four balls in a row on a floor that touch each other; their contacts have two kinds of rows."""
    slides = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
    balls = "".join(
        f'<body pos="{0.2 * number:.1f} 0 0.1">{slides}<geom size="0.1" condim="{dim}" mass="1"/></body>'
        for number, dim in enumerate((4, 3, 3, 4))
    )
    world = f'<worldbody><geom type="plane" size="5 5 1" condim="3"/>{balls}</worldbody>'
    return mujoco_models.as_c(mujoco.MjModel.from_xml_string(f'<mujoco><option cone="{cone}"/>{world}</mujoco>'))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cone", "within"), [("pyramidal", 1e-4), pytest.param("elliptic", 2e-3, marks=pytest.mark.long)]
)
def test_forces_are_the_same_however_many_contacts_are_solved_at_once(cone: str, within: float):
    """In states with one contact, with two, and with more than are solved at once."""
    model, rng = sliding_balls(cone), np.random.default_rng(0)
    mx = mujoco_parts.put_model(model)
    data: Any = mujoco_parts.mjx.make_data(mx)
    qpos = (rng.choice([-1e-3, 0.3], (64, model.nq)) * rng.random((64, model.nq))).astype(np.float32)
    qvel = rng.normal(0.0, 0.3, qpos.shape).astype(np.float32)

    def forward(at_once: tuple[int, ...], qpos: Any, qvel: Any) -> tuple[Any, ...]:
        state = mujoco_parts.start(mx, qpos, qvel)
        found = mujoco_parts._forward(mx, mujoco_parts._data(data, state, np.zeros(0)), at_once)
        return found.qacc, found.qfrc_constraint, found._impl.efc_force, found._impl.contact.dist

    *right, dist = compile_kernel(functools.partial(forward, (1000,)), qpos[0], qvel[0])(qpos, qvel)
    groups = [np.flatnonzero(data._impl.contact.dim == dim) for dim in (3, 4)]
    most = np.max([(dist < 0)[:, group].sum(1) for group in groups], axis=0)
    assert min((most <= 1).sum(), (most == 2).sum(), (most > 2).sum()) >= 5
    few = compile_kernel(functools.partial(forward, (1, 2)), qpos[0], qvel[0])
    for ours, all_at_once in zip(few(qpos, qvel), right, strict=False):
        scale = float(np.abs(all_at_once).max())
        assert scale > 1.0
        np.testing.assert_allclose(ours, all_at_once, atol=within * scale)


POLE = """<body name="pole" pos="-1 0 0.5">
  <joint name="hinge" axis="0 1 0" damping="0.5" limited="true" range="-60 60"/>
  <geom type="capsule" fromto="0 0 0 0 0 0.4" size="0.05"/></body>"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("option", "within"),
    [
        ('integrator="Euler"', 1e-4),
        ('integrator="implicitfast" cone="elliptic"', 1e-4),
        ('integrator="RK4"', 1e-4),
        ('solver="CG"', 3e-3),  # in float32 it stops earlier
        ('solver="CG" cone="elliptic"', 3e-3),
    ],
)
def test_integrators_cones_and_solvers_are_those_of_c_mujoco(option: str, within: float):
    """Two balls and a damped pole that is pushed beyond its limit; Euler integrates its damping implicitly."""
    motor = '<actuator><motor joint="hinge" gear="2"/></actuator>'
    model = mujoco_models.as_c(model_of(option=option, more=POLE, after=motor))
    mx = mujoco_parts.put_model(model)
    states = mujoco_models.c_states(model, 5, 64)
    ctrl = mujoco_models.random_ctrl(model, 64, np.random.default_rng(1))
    start = mujoco_parts.start(mx)
    kernel = compile_kernel(lambda state, ctrl: mujoco_parts.step(mx, state, ctrl, 5), start, np.zeros(1, np.float32))
    ours, theirs = kernel(states, ctrl), mujoco_models.c_step(model, 5, states, ctrl)
    assert (theirs.contacts > 0).mean() > 0.5
    for of, to in ((ours.qpos, theirs.qpos), (ours.qvel, theirs.qvel)):
        assert np.quantile(mujoco_models.relative_error(of, to), 0.95) < within


TOP = """<mujoco><option timestep="0.05" gravity="0 0 0" integrator="RK4"/><worldbody>
  <body><freejoint/><geom type="box" size=".1 .2 .3" mass="1"/></body></worldbody></mujoco>"""


@pytest.mark.long
def test_a_free_body_turns_with_rk4_as_in_c_mujoco():
    """Without the rates of its rotation vector, the quaternion is wrong by 3e-4."""
    model = mujoco.MjModel.from_xml_string(TOP)
    data, mx = mujoco.MjData(model), mujoco_parts.put_model(model)
    data.qvel[3:] = 3.0, -5.0, 2.0
    state = mujoco_parts.step(mx, mujoco_parts.start(mx, qvel=data.qvel), np.zeros(0))
    mujoco.mj_step(model, data)
    np.testing.assert_allclose(state.qpos, data.qpos, atol=1e-6)
    np.testing.assert_allclose(state.qvel, data.qvel, atol=1e-5)


SLOW = """<mujoco><option timestep="0.02" integrator="RK4"/><worldbody><body pos="0 0 1">
  <joint name="j" type="hinge" axis="0 1 0" {joint}/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".05" {geom}/>
  <site name="s" pos=".3 0 0"/></body></worldbody><actuator><general name="m" joint="j" {actuator}/></actuator>
  <sensor><accelerometer site="s"/><force site="s"/></sensor></mujoco>"""


def slow(joint: str = "", geom: str = "", actuator: str = "") -> MjModel:
    return mujoco.MjModel.from_xml_string(SLOW.format(joint=joint, geom=geom, actuator=actuator))


@pytest.mark.slow
@pytest.mark.parametrize("more", ['dyntype="filterexact"', 'dyntype="integrator" actlimited="true" actrange="0 .015"'])
def test_activations_change_with_rk4_as_in_c_mujoco(more: str):
    model = slow(actuator=f'dynprm=".02" gainprm="20" {more}')
    data, mx = mujoco.MjData(model), mujoco_parts.put_model(model)
    data.ctrl[:] = 1.0
    mujoco.mj_step(model, data)
    state = mujoco_parts.step(mx, mujoco_parts.start(mx), np.ones(1, np.float32))
    for ours, theirs in ((state.qpos, data.qpos), (state.qvel, data.qvel), (state.act, data.act)):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5)


@pytest.mark.slow
def test_sensors_of_accelerations_are_computed_without_constraints_too():
    model = slow(actuator='gainprm="1"')
    data, mx = mujoco.MjData(model), mujoco_parts.put_model(model)
    data.qvel[:], data.ctrl[:] = 1.0, 0.5
    mujoco.mj_forward(model, data)
    found = mujoco_parts.forward(mx, mujoco_parts.start(mx, qvel=np.ones(1)), np.full(1, 0.5))
    assert np.abs(data.sensordata).max() > 1.0
    np.testing.assert_allclose(found.sensordata, data.sensordata, atol=1e-4)


@pytest.mark.parametrize(
    ("parts", "named"),
    [
        ({"joint": 'stiffness="1 20"'}, r"joint 'j' \(stiffnesspoly\)"),
        ({"joint": 'damping="1 20"'}, r"joint 'j' \(dampingpoly\)"),
        ({"joint": 'stiffness="5" springyield="0.1"'}, r"joint 'j' \(springyield\)"),
        ({"geom": 'adhesion="3"'}, r"geom 0 \(adhesion\)"),
        ({"actuator": 'damping="1"'}, r"actuator 'm' \(damping\)"),
        ({"actuator": 'armature="1"'}, r"actuator 'm' \(armature\)"),
    ],
)
@pytest.mark.skipif(not hasattr(mujoco.MjModel, "jnt_springyield"), reason="they came with MuJoCo 4")
def test_what_came_with_mujoco_4_and_mjx_lacks_is_refused_by_its_name(parts: dict[str, str], named: str):
    with pytest.raises(TaskError, match=named):
        mujoco_parts.put_model(slow(**parts))


LYING = """<mujoco><default><geom margin=".004"/></default><worldbody>
  <body><freejoint/><geom type="capsule" size=".02 .05"/></body>
  <body><freejoint/><geom type="cylinder" size=".05 .05"/></body></worldbody></mujoco>"""


def test_a_capsule_touches_a_cylinder_where_it_does_in_c_mujoco():
    """But for capsules that lie on a flat end or along the side, for which C MuJoCo has two contacts."""
    model, rng = mujoco.MjModel.from_xml_string(LYING), np.random.default_rng(0)
    data, mx, rows, two = mujoco.MjData(model), mujoco_parts.put_model(model), [], 0
    while len(rows) < 100:
        turns = rng.normal(size=(2, 4))
        turns /= np.linalg.norm(turns, axis=1)[:, None]
        data.qpos[:] = [*rng.normal(0.0, 0.07, 3), *turns[0], 0.0, 0.0, 0.0, *turns[1]]
        mujoco.mj_forward(model, data)
        two += data.ncon == 2
        if data.ncon == 1 and data.contact[0].dist > -0.01:
            (contact,) = data.contact
            rows.append((np.float32(data.qpos), contact.dist, contact.pos.copy(), contact.frame[:3].copy()))
    assert 0 < two < 50, "most have one; before MuJoCo 4 there are twice as many with two"

    def touch(qpos: Any) -> tuple[Any, Any, Any]:
        found: Any = mujoco_parts.forward(mx, mujoco_parts.start(mx, qpos), np.zeros(0))
        contact = found._impl.contact
        return contact.dist[0], contact.pos[0], contact.frame[0, 0]

    qpos, *truth = (np.array(column) for column in zip(*rows, strict=True))
    for of, to, within in zip(compile_kernel(touch, qpos[0])(qpos), truth, (1e-6, 1e-5, 1e-3), strict=True):
        np.testing.assert_allclose(of, to, atol=within)
