"""A user's class with a model of MuJoCo is a task; what is wrong with it is named. Oracle: C MuJoCo."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import textwrap
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from es_service import api
from es_service.cli.doctor import step_findings
from es_service.protocol.errors import TaskError
from es_service.protocol.sources import modules_of, user_sources
from es_service.runs.certification import certify, certify_run
from workers.environments import describe_environment, make_environment
from workers.environments.mujoco_parts import mujoco
from workers.step_checks import LANES, step_cost

ROOT = Path(__file__).parents[2]
ARM = "tests.examples.reaching_arm:ReachingArm"
XML = """<mujoco><option timestep="0.01"/><worldbody><body><joint type="slide" axis="1 0 0"/><geom size="0.1"/>
<site name="tip" pos="0.5 0 0"/></body></worldbody>
<actuator><motor ctrlrange="-2 4" gear="50" joint="{joint}"/></actuator>
<sensor><jointpos joint="{joint}"/></sensor></mujoco>"""
XML = XML.replace('<joint type="slide"', '<joint name="{joint}" type="slide"').replace("{joint}", "x")


class Slider:
    """A cart slides."""

    model = XML
    frame_skip, episode_steps = 5, 20
    descriptor_names, descriptor_bounds = ("x",), ((-1.0, 1.0),)
    mj_model: Any

    def reward(self, data, earlier):
        return data.sensordata[0] - earlier.qpos[0] + 0.0 * data.ctrl[0]

    def done(self, data):
        return data.qpos[0] > 0.1

    def descriptor(self, data):
        return data.site_xpos[self.mj_model.site("tip").id, :1]

    def success(self, data, before):
        """It has been beyond 0.05."""
        return before | (data.qpos[0] > 0.05)


@pytest.mark.slow
def test_a_control_step_is_that_of_c_mujoco():
    """Also bounds of actuators, sensors and sites of the state after it, the data before it, and the end."""
    environment = make_environment(f"{__name__}:Slider", {})
    state = jax.jit(environment.reset)(jnp.zeros(4, jnp.uint32))
    np.testing.assert_array_equal(environment.observe(state), [0.0, 0.0])
    model = mujoco.MjModel.from_xml_string(XML)
    data, step = mujoco.MjData(model), jax.jit(environment.step)
    for action in (0.5, 1.0, 7.0):
        x = data.qpos[0]
        data.ctrl[:] = min(1.0 + 3.0 * action, 4.0)
        mujoco.mj_step(model, data, 5)
        mujoco.mj_forward(model, data)
        state, reward, done = step(state, jnp.array([action], jnp.float32))
        np.testing.assert_allclose(environment.observe(state), [data.qpos[0], data.qvel[0]], rtol=1e-5)
        np.testing.assert_allclose(environment.descriptor(state), data.site_xpos[0, :1], rtol=1e-5)
        np.testing.assert_allclose(reward, data.sensordata[0] - x, rtol=1e-4)
        assert bool(done) == (data.qpos[0] > 0.1)
        beyond = data.qpos[0] > 0.05
        assert [bool(environment.success(state, jnp.bool_(before))) for before in (False, True)] == [beyond, True]
    assert bool(done)


class NoReward:
    """Lacks what it needs."""

    model, frame_skip, episode_steps = XML, 5, 20
    descriptor_names, descriptor_bounds = ("x",), ((-1.0, 1.0),)

    def descriptor(self, data):
        return data.qpos


class WideReward(Slider):
    def reward(self, data, earlier):
        return data.qpos


class TwoDescriptors(Slider):
    def descriptor(self, data):
        return data.site_xpos[0]


class Nothing(Slider):
    def descriptor(self, data):
        pass


class ShortReset(Slider):
    def reset(self, key):
        return jnp.zeros(2), jnp.zeros(1)


class BrokenXml(Slider):
    model = "<mujoco><worldbody><body><geom siz='0.1'/></body></worldbody></mujoco>"


class NoFile(Slider):
    model = "slider.xml"


class OtherSolver(Slider):
    model = XML.replace('timestep="0.01"', 'timestep="0.01" solver="PGS"')


class NoFrames(Slider):
    frame_skip = 0


class TrueFrames(Slider):
    frame_skip = True


class TextDescriptor(Slider):
    def descriptor(self, data):
        return "high"


class FloatDone(Slider):
    def done(self, data):
        return data.qpos[0]


class ManyArguments(Slider):
    def done(self, data, earlier, later):
        return data.qpos[0] > 0.1


class DrawsByJax(Slider):
    def reset(self, key):
        return jax.random.normal(key, (1,)), jnp.zeros(1)


class NoActuator(Slider):
    model = XML.replace('<motor ctrlrange="-2 4" gear="50" joint="x"/>', "")


class NoSuchJoint(Slider):
    model = XML.replace('gear="50" joint="x"', 'gear="50" joint="elbow"')


class MeshOfText(Slider):
    model = XML.replace("<worldbody>", '<asset><mesh file="t.obj"/></asset><worldbody>')


class BeyondMjx(Slider):
    """MJX has rays, but not without materials."""

    model = XML.replace("<jointpos", '<rangefinder site="tip"/><jointpos')


@pytest.mark.parametrize(
    ("name", "sentences"),
    [
        ("NoReward", ["has no reward; workers/environments/mujoco_task.py lists"]),
        ("WideReward", ["reward returned an array of the shape (1,); it must be ()"]),
        ("TwoDescriptors", ["descriptor returned an array of the shape (3,); it must be (1,)"]),
        ("Nothing", ["descriptor returned None (is a `return` missing?)"]),
        ("ShortReset", ["reset returned positions of the shape (2,); must be (1,), the nq of the model"]),
        ("BrokenXml", ["MuJoCo cannot read its XML: ", "unrecognized attribute: 'siz'", "line 1"]),
        ("NoFile", ["model = 'slider.xml': there is no file ", "relative to the folder of the class"]),
        ("OtherSolver", ["MJX lacks parts of this MuJoCo model: option solver = pgs; must be "]),
        ("NoFrames", ["frame_skip = 0 is not positive"]),
        ("TrueFrames", ["frame_skip = True is not of type int"]),
        ("TextDescriptor", ["descriptor returned 'high'; it must return one array"]),
        ("FloatDone", ["done returned float32; it must return bool, such as data.qpos[2] < 0.2"]),
        ("ManyArguments", ["done has the parameters (data, earlier, later); it is called as done(data, earlier)"]),
        ("DrawsByJax", ["reset(key) passes its key to jax.random", "noise.uniforms(key, counters), or a key of JAX"]),
        ("NoActuator", ["the model has no actuator, so a policy could do nothing; give it an element <actuator>"]),
        ("NoSuchJoint", ["MuJoCo cannot read its XML: unknown transmission target 'elbow'"]),
        ("MeshOfText", ["its XML reads the file t.obj, which would be no part", "a file beside the module and name"]),
        ("BeyondMjx", ["MJX cannot compute this model: TypeError: Slice size"]),
    ],
)
def test_what_is_wrong_is_named(name, sentences):
    with pytest.raises(TaskError) as raised:
        describe_environment(f"{__name__}:{name}")
    assert str(raised.value).startswith(f"{__name__}:{name}")
    assert "\n" not in str(raised.value), "one sentence"
    for sentence in sentences:
        assert sentence in str(raised.value)


FILES = {
    "robots/slide.py": """
        from tests.workers.test_mujoco_task import Slider
        class Slide(Slider):
            model = "models/slide.xml"
        class Hidden(Slider):
            model = "models/" + "hid" + "den.x" + "ml"
        """,
    "robots/models/slide.xml": '<mujoco><compiler meshdir="m"/><include file="part.xml"/></mujoco>',
    "robots/models/hidden.xml": XML,
    "robots/models/part.xml": XML.replace("<worldbody>", '<asset><mesh name="t" file="t.obj"/></asset><worldbody>')
    .replace("<mujoco>", "<mujocoinclude>")
    .replace("</mujoco>", "</mujocoinclude>"),
    "robots/models/m/t.obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n",
}


def test_the_files_of_a_model_are_code(tmp_path, monkeypatch):
    """What it includes and its meshes, too; a file that no string names is refused."""
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(textwrap.dedent(text))
    monkeypatch.syspath_prepend(str(tmp_path))
    task = describe_environment("robots.slide:Slide")
    assert (task.observation_size, task.action_size) == (2, 1)
    before = user_sources("robots.slide:Slide")
    models = {name for name in FILES if name.endswith((".xml", ".obj")) and "hidden" not in name}
    assert before.keys() == {"robots/slide.py", *models}
    assert modules_of("robots.slide:Slide").models == {name: tmp_path / name for name in models}
    for name in models:
        (tmp_path / name).write_text((tmp_path / name).read_text() + "\n")
        after = user_sources("robots.slide:Slide")
        assert {source for source in after if after[source] != before[source]} == {name}
        before = after
    with pytest.raises(TaskError, match=r"hidden.xml would be no part of the run's identity.*model = \"hidden.xml\""):
        describe_environment("robots.slide:Hidden")
    (tmp_path / "robots/models/m/t.obj").unlink()
    with pytest.raises(TaskError, match=r"cannot read models/slide.xml: .*t\.obj'; names in a model are relative to"):
        describe_environment("robots.slide:Slide")
    for module in ("robots", "robots.slide"):
        sys.modules.pop(module, None)


@pytest.mark.slow
def test_what_a_control_step_costs_and_how_far_it_is_from_c_mujoco():
    """For `doctor`: C MuJoCo's own error by an ulp is of the same size; the descriptor leaves its bounds."""
    cost = step_cost(describe_environment(f"{__name__}:Slider"), {}, 0.0)
    assert cost.operations > 0
    assert cost.steps_per_second > 0
    assert cost.greatest_B[0] > 1.0
    assert cost.from_c["states"] == LANES
    assert 0.0 < cost.from_c["p99"] < 8.0 * cost.from_c["ulp_p99"] < 1e-4
    findings = step_findings(describe_environment(f"{__name__}:Slider"), asdict(cost))
    levels = {sentence.partition(" ")[0]: level for level, sentence in findings}
    assert levels == {"a": "ok", "with": "note", "after": "ok"}


def blocks_of_the_guide() -> list[str]:
    """The class and the script in the guide's section about models of one's own."""
    guide = (ROOT / "workers" / "own_tasks.md").read_text()
    section = guide.partition("\n## A model of your own\n")[2].partition("\n## ")[0]
    return re.findall(r"^```text\n(.*?)^```", section, re.MULTILINE | re.DOTALL)


def test_the_guide_shows_what_is_in_the_example():
    """Its class is the example's, but for comments and what it leaves out; its script's config has known keys."""
    shown, script = blocks_of_the_guide()
    example = ROOT / "tests" / "examples" / "reaching_arm.py"
    lines_of = [[line.partition("  #")[0] for line in text.splitlines()] for text in (example.read_text(), shown)]
    assert len(shown.splitlines()) > 8
    assert [line for line in lines_of[1] if line not in lines_of[0]] == []
    names: dict[str, Any] = {}
    exec(script.partition("print(")[0], names)
    assert names["config"]["task"].pop("environment") == ARM
    api.load_config(names["config"] | {"task": {"environment": "point_maze"} | names["config"]["task"]})


@pytest.mark.long
def test_the_script_of_the_guide_prints_a_map(tmp_path):
    """It takes half a minute, most of which is the description of the task and the code of its episodes."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-c", blocks_of_the_guide()[1]]
    run = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=500, check=True)
    assert len([line for line in run.stdout.splitlines() if line[:1].isdigit()]) == 5, "the five fittest elites"


@pytest.mark.slow
def test_the_arm_of_the_examples_reaches_its_target_in_its_model():
    """Its positions and the place of its hand are those of C MuJoCo; its reset heeds its option."""
    environment = make_environment(ARM, {"noise": 0.0})
    state = jax.jit(environment.reset)(jnp.arange(4, dtype=jnp.uint32))
    np.testing.assert_allclose(environment.descriptor(state), [0.0, -0.8], atol=1e-6)
    np.testing.assert_allclose(environment.goal_distance(state), np.hypot(0.55, 0.82), rtol=1e-5)
    assert not bool(environment.success(state, jnp.bool_(True)))
    assert "tests/examples/reaching_arm.xml" in user_sources(ARM)


@pytest.mark.long
@pytest.mark.usefixtures("one_process")
def test_a_short_training_of_the_arm_is_certified_to_be_better_than_a_random_policy(tmp_path):
    """Whole intervals of 95 % apart; and the policies move the hand to different places."""
    task = {"environment": ARM, "episode_steps": 50}
    search = {"algorithm": "es", "pairs": 32, "sigma": 0.1, "step": {"kind": "adam", "learning_rate": 0.1}}
    config = api.load_config(
        {
            "task": task,
            "policy": {"hidden": []},
            "search": search | {"evaluation_episodes": 4},
            "budget": {"generations": 12},
            "compute": {"engine": "inline", "workers": 1},
        }
    )
    run = api.run(config, tmp_path / "arm", progress=False).run
    [trained] = certify_run(run.folder, top=0, episodes=64)
    random_N_D = 0.3 * np.random.default_rng(0).normal(size=(4, trained.policy.parameters_D.size))
    random = certify(random_N_D, config, episodes=64, keep=4)
    print("\n", trained.row()["return_low"], [one.row()["return_high"] for one in random])
    assert trained.row()["return_low"] > max(one.row()["return_high"] for one in random)
    assert np.isfinite(trained.episodes.goal_distance_E).all()
    assert np.ptp([one.episodes.descriptor_E_B.mean(0) for one in random], axis=0).max() > 0.1
