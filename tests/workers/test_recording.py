"""Recorded episodes are the episodes that a worker evaluates, bit for bit."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from es_service.loop.contents import policy_work
from es_service.protocol.episodes import gathered
from es_service.protocol.messages import EvaluationChunk, PolicySpec
from es_service.protocol.noise import Domain
from es_service.protocol.recordings import RecordRequest, Scene
from tests import helpers
from tests.workers.test_episode_ends import counting_environment
from workers import environments
from workers.environments import SHIPPED
from workers.rollouts import recorder
from workers.viewer import Viewer, scene


def spec_of(name, rollout, steps):
    task = SHIPPED[name]
    shape = PolicySpec((task.observation_size, 8, task.action_size))
    return helpers.spec(environment=name, policy=shape, episode_steps=steps, rollout=rollout)


TASKS = [("point_maze", 200, "xla"), ("point_maze", 200, "simd")]
TASKS += [pytest.param("ant_trap", 60, "simd", marks=pytest.mark.long)]
FOUR_TIMES = [pytest.mark.long, pytest.mark.timeout(3600)]  # XLA compiles the ant
TASKS += [pytest.param("ant_trap", 60, "xla", marks=FOUR_TIMES)]


@pytest.mark.parametrize(("name", "steps", "rollout"), TASKS)
def test_a_recording_is_the_worker_s_own_episode(name, steps, rollout):
    """That of a centre, also of an initial one, whose episodes are counted on, that of a policy in any slot, and
    any one of a policy that is certified."""
    spec, size = spec_of(name, rollout, steps), SHIPPED[name].observation_size
    run = helpers.chunk_runner(spec)
    parameters_N_D = np.stack([helpers.random_parameters(n, spec.policy.parameters) for n in range(19)])
    centre = helpers.centre(parameters_N_D[0], generation=7, observation_size=size)
    mean_N_O, std_N_O = (np.tile(array, (19, 1)) for array in (centre.observation_mean_O, centre.observation_std_O))
    work = policy_work(parameters_N_D, (mean_N_O, std_N_O), 2, seed=5, generation=7, ask=1, traces=True)
    policies = gathered([work.shape], [run(*one) for one in work.work])[0]
    asked = []
    for n in (0, 3, 18):
        request = RecordRequest(replace(centre, parameters_D=parameters_N_D[n]), seed=5, ask=1, policy=n)
        asked.append((request, policies, (n, 0), policies.trace_T_B[n]))
    domain = Domain.CERTIFICATION_RESET
    alone = policy_work(parameters_N_D[:1], (mean_N_O[:1], std_N_O[:1]), 19, seed=5, generation=7, domain=domain)
    certified = gathered([alone.shape], [run(*one) for one in alone.work])[0]
    asked += [
        (RecordRequest(centre, seed=5, policy=0, episode=e, domain=domain), certified, (0, e), None) for e in (0, 3, 18)
    ]
    for chunk, ask in ((0, 0), (2, 0), (0, 2)):
        found = run(centre, EvaluationChunk(7, chunk, ask))
        for e in (0, 3):
            request = RecordRequest(centre, spec.seed, ask, episode=16 * chunk + e)
            asked.append((request, found, e, None if e else found.trace_T_B))
    recordings = recorder("", spec)([request for request, *_ in asked]).recordings
    for one, (_, evaluated, at, trace_T_B) in zip(recordings, asked, strict=True):
        assert one.returns_T.size == evaluated.steps[at] + 1
        np.testing.assert_array_equal(one.fitness, evaluated.fitness[at])
        np.testing.assert_array_equal(one.descriptor_T_B[-1], evaluated.descriptor[at])
        if trace_T_B is not None:
            np.testing.assert_array_equal(one.trace_T_B, trace_T_B)
        assert (one.poses_T_L_7 is None) == (name == "point_maze")


@pytest.mark.parametrize("rollout", ["xla", "simd"])
def test_a_recording_ends_with_its_episode(monkeypatch, rollout):
    """Each step's reward is its number; nothing after `done` is recorded."""
    environment = counting_environment([5], poison_after_done=False)
    monkeypatch.setattr(environments, "make_environment", lambda name, options: environment)
    spec = helpers.spec(episode_steps=30, rollout=rollout)
    [found] = recorder("", spec)([RecordRequest(helpers.centre(helpers.random_parameters()), seed=0)]).recordings
    assert found.returns_T.tolist() == [0, 1, 3, 6, 10, 15]
    assert found.descriptor_T_B[:, 1].tolist() == [0, 1, 2, 3, 4, 5]
    assert found.fitness == 15


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param("ant_maze", marks=pytest.mark.long), "ant_trap"])
def test_the_poses_of_an_ant_are_those_of_its_links(name):
    spec = spec_of(name, "simd", 30)
    size = SHIPPED[name].observation_size
    centre = helpers.centre(helpers.random_parameters(size=spec.policy.parameters), observation_size=size)
    evaluated = helpers.chunk_runner(spec)(centre, EvaluationChunk(1, 0))
    found = recorder("", spec)([RecordRequest(centre, spec.seed)])
    [one] = found.recordings
    np.testing.assert_array_equal(one.fitness, evaluated.fitness[0])
    np.testing.assert_array_equal(one.trace_T_B, evaluated.trace_T_B)
    assert one.poses_T_L_7.shape == (31, 9, 7)
    if name == "ant_maze":  # the descriptor of AntTrap is clipped
        np.testing.assert_allclose(one.poses_T_L_7[:, 0, :2], one.descriptor_T_B, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(one.poses_T_L_7[..., 3:], axis=-1), 1.0, atol=1e-4)
    # A lower leg hangs from its upper leg, 0.2 m along x and y, wherever the ant is.
    along = np.linalg.norm(one.poses_T_L_7[:, 2, :3] - one.poses_T_L_7[:, 1, :3], axis=-1)
    np.testing.assert_allclose(along, np.hypot(0.2, 0.2), atol=0.05)
    shapes = found.scene.shapes
    walls = [shape for shape in shapes if shape.kind == "box"]
    assert len(walls) == len(SHIPPED[name].walls)
    assert {shape.link for shape in walls} == {-1}
    assert {shape.link for shape in shapes if shape.kind == "capsule"} == set(range(9))
    assert found.scene.step_s == pytest.approx(0.05)


def test_the_poses_of_a_task_of_mujoco_are_those_of_c_mujoco():
    """Also those of bodies that nothing moves, and of the world's geoms, which have link -1."""
    from workers.environments.mujoco_parts import mujoco, mujoco_viewer, put_model, start

    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="plane" size="1 1 1"/><body name="post" pos="0 2 1"><geom size="0.1"/></body>
        <body pos="0 0 1"><joint type="slide" axis="1 0 0"/><geom size="0.1"/><body pos="0.5 0 0" euler="0 0 90">
        <joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 1 0 0" size="0.05"/></body></body>
        </worldbody></mujoco>"""
    )
    mx, data = put_model(model), mujoco.MjData(model)
    viewer = mujoco_viewer(model, mx, 0.05, lambda state: state["physics"])
    data.qpos[:] = 0.7, -0.4
    mujoco.mj_kinematics(model, data)
    poses = jax.jit(viewer.poses)({"physics": start(mx, data.qpos)})
    np.testing.assert_allclose(poses.pos, data.xpos[1:], atol=1e-6)
    np.testing.assert_allclose(poses.rot, data.xquat[1:], atol=1e-6)
    seen = scene(viewer)
    assert [(shape.kind, shape.link) for shape in seen.shapes] == [
        ("plane", -1), ("sphere", 0), ("sphere", 1), ("capsule", 2),
    ]  # fmt: skip
    assert (seen.step_s, seen.notes) == (0.05, ())


TETRAHEDRON = 'vertex="0 0 0 1 0 0 0 1 0 0 0 1"'


def scene_of(assets: str, bodies: str) -> Scene:
    import mujoco

    xml = f"<mujoco><asset>{assets}</asset><worldbody>{bodies}</worldbody></mujoco>"
    return scene(Viewer(mujoco.MjModel.from_xml_string(xml), lambda state: None, 0.1))


def test_geoms_and_sites_of_hidden_groups_and_without_colour_are_left_out():
    seen = scene_of(
        "",
        """<geom type="plane" size="1 1 1"/><body><freejoint/>
        <geom type="sphere" size="0.3" pos="0 0 1" rgba="1 0 0 1"/><geom type="box" size="1 2 3" group="3"/>
        <geom type="box" size="1 2 3" rgba="0 0 0 0"/><site type="cylinder" size="0.1 0.2"/><site group="4"/></body>""",
    )
    plane, sphere, site = seen.shapes
    assert (plane.kind, plane.link) == ("plane", -1)
    assert (sphere.kind, sphere.link, sphere.size[0], sphere.position) == ("sphere", 0, 0.3, (0.0, 0.0, 1.0))
    assert sphere.colour == (1.0, 0.0, 0.0, 1.0)
    assert (site.kind, site.link, site.size[:2]) == ("cylinder", 0, (0.1, 0.2))


def test_a_geom_has_the_colour_of_its_material_unless_it_has_its_own():
    seen = scene_of(
        '<material name="red" rgba="1 0 0 0.5"/>',
        '<body><freejoint/><geom size="1" material="red"/><geom size="1" material="red" rgba="0 1 0 1"/></body>',
    )
    assert [shape.colour for shape in seen.shapes] == [(1.0, 0.0, 0.0, 0.5), (0.0, 1.0, 0.0, 1.0)]


def test_meshes_are_those_of_the_model_and_what_is_not_drawn_is_said(monkeypatch):
    """Two geoms share a mesh; the points of a geom are where C MuJoCo has them."""
    assets = (
        f'<mesh name="unused" {TETRAHEDRON}/><mesh name="a" {TETRAHEDRON}/><mesh name="b" {TETRAHEDRON} scale="2 2 2"/>'
        '<hfield name="h" nrow="2" ncol="2" size="1 1 1 1"/>'
    )
    bodies = """<geom type="hfield" hfield="h"/><body pos="0 0 3"><freejoint/><geom type="mesh" mesh="b"/>
        <geom type="mesh" mesh="a" pos="5 0 0"/><geom type="mesh" mesh="b" pos="9 0 0"/></body>"""
    seen = scene_of(assets, bodies)
    assert [shape.mesh for shape in seen.shapes] == [1, 0, 1]
    assert seen.notes == ("Not drawn: height fields (1).",)
    first = seen.shapes[0]
    w, *v = first.rotation
    places = [place + 2 * np.cross(v, np.cross(v, place) + w * place) for place in seen.meshes[1].vertices_V_3]
    wanted = {(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 2.0)}
    assert {tuple(np.abs(np.round(place + first.position, 3)).tolist()) for place in places} == wanted
    monkeypatch.setattr("workers.viewer.MOST_TRIANGLES", 3)
    hulls = scene_of(assets, bodies)
    assert hulls.notes[0] == "Meshes of more than 3 triangles are drawn as their convex hulls: 2."
    faces = [{frozenset(face) for face in found.meshes[1].triangles_F_3.tolist()} for found in (seen, hulls)]
    assert faces[0] == faces[1]
    assert len(faces[0]) == 4
