"""An episode whose policy is given what is not finite is invalid and named, in every rollout; no other one changes."""

from __future__ import annotations

from typing import Any

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest

from es_service import api
from es_service.cli.doctor import task_findings
from es_service.errors import EvaluationError
from es_service.protocol.messages import EvaluationChunk, TrainingChunk
from es_service.protocol.noise import uniforms
from es_service.protocol.options import Option
from es_service.protocol.policies import Policies, PolicyChunk
from es_service.protocol.policy_spec import PolicySpec
from tests.helpers import centre, spec
from workers.worker import make_worker

STEPS, OBSERVATIONS, BAD = 12, 3, 1
"""Steps and observations of the tasks, and the number of the observation that fails."""
VALUES = {"none": 0.5, "nan": np.nan, "infinite": np.inf, "reward": 0.5, "infeasible": np.nan}
SHAPE = PolicySpec((OBSERVATIONS, 4, 1), activation="relu")


class Sensor:
    """a point on a line with a sensor that fails once, after a step, in the episodes that start left of 0"""

    observation_size, action_size, episode_steps = OBSERVATIONS, 1, STEPS
    descriptor_names, descriptor_bounds = ("x",), ((-3.0, 3.0),)
    options = {"fault": tuple(VALUES), "after": Option(4, low=0), "ends": Option(STEPS, low=1)}  # noqa: RUF012

    def __init__(self, fault="none", after=4, ends=STEPS):
        self.fault, self.after, self.ends = fault, after, ends

    def reset(self, key):
        x = 2.0 * uniforms(key, jnp.zeros(1, jnp.uint32))[0] - 1.0
        return x, x < 0.0, jnp.int32(0)

    def observe(self, state):
        x, fails, time = state
        value = jnp.float32(VALUES[self.fault])
        if self.fault == "infinite":
            value, is_bad = jnp.where(time % 2 == 0, value, -value), fails
        else:
            is_bad = fails & (time == self.after)
        return jnp.stack([x, jnp.where(is_bad, value, 0.5), jnp.float32(1.0)])

    def step(self, state, action):
        x, fails, time = state
        x, time = x + 0.1 * jnp.clip(jnp.nan_to_num(action[0]), -1.0, 1.0), time + 1
        worst = {"reward": jnp.nan, "infeasible": -jnp.inf}.get(self.fault, 0.0)
        is_bad = fails & (time == self.after) & (worst != 0.0)
        return (x, fails, time), jnp.where(is_bad, worst, -jnp.abs(x)), time >= self.ends

    def descriptor(self, state):
        return jnp.clip(state[0], -3.0, 3.0)[None]


class PythonSensor:
    """the same as an object"""

    observation_size, action_size, episode_steps = OBSERVATIONS, 1, STEPS
    options = Sensor.options

    def __init__(self, fault="none", after=4, ends=STEPS):
        self.fault, self.after, self.ends = fault, after, ends

    def reset(self, seed):
        self.x, self.time = seed / 2**30 - 1.0, 0
        self.fails = self.x < 0.0
        return self.observation()

    def observation(self):
        value = VALUES[self.fault]
        if self.fault == "infinite":
            value, is_bad = value if self.time % 2 == 0 else -value, self.fails
        else:
            is_bad = self.fails and self.time == self.after
        return self.x, value if is_bad else 0.5, 1.0

    def step(self, action):
        self.x, self.time = self.x + 0.1 * float(np.clip(np.nan_to_num(action[0]), -1.0, 1.0)), self.time + 1
        worst = {"reward": np.nan, "infeasible": -np.inf}.get(self.fault, 0.0)
        is_bad = self.fails and self.time == self.after and worst != 0.0
        return self.observation(), worst if is_bad else -abs(self.x), self.time >= self.ends


class GymnasiumSensor(gymnasium.Env):
    """the same as an environment of Gymnasium"""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBSERVATIONS,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, fault="none", after=4, ends=STEPS):
        self._sensor = PythonSensor(fault, after, ends)

    def reset(self, *, seed=None, options=None):
        return self._sensor.reset(seed), {}

    def step(self, action):
        observation, reward, done = self._sensor.step(action)
        return observation, reward, done, False, {}


gymnasium.register("Sensor-v0", f"{__name__}:GymnasiumSensor")
TASKS = [
    ("xla", f"{__name__}:Sensor"),
    ("simd", f"{__name__}:Sensor"),
    ("host", f"python:{__name__}:PythonSensor"),
    ("host", f"gymnasium:{__name__}:Sensor-v0"),
]
CHUNKS = ["training", "evaluation", "policies"]


def result_of(
    rollout: str,
    task: str,
    kind: str,
    fault: str,
    clip: float | None = None,
    *,
    infeasible: bool = False,
    **options: Any,
) -> Any:
    """The result of a chunk of each kind, which has the same address each time; two chunks run together."""
    worker_spec = spec(
        environment=task,
        environment_options={"fault": fault, "after": 4, "ends": STEPS} | options,
        rollout=rollout,
        policy=SHAPE,
        episode_steps=STEPS,
        observation_clip=clip,
        outputs=("observation",),
        allow_infeasible=infeasible,
    )
    parameters_D = np.random.default_rng(0).normal(size=SHAPE.parameters).astype(np.float32)
    of_centre = centre(parameters_D, observation_size=OBSERVATIONS)
    policies = Policies(0, 4, 3, False, np.stack([parameters_D, -parameters_D, 2 * parameters_D]), None, None)
    work = {
        "training": [(of_centre, TrainingChunk(1, chunk)) for chunk in (0, 1)],
        "evaluation": [(of_centre, EvaluationChunk(1, chunk, 10)) for chunk in (0, 1)],
        "policies": [(policies, PolicyChunk(1, chunk)) for chunk in (0,)],
    }[kind]
    return make_worker(worker_spec)(work)[-1]


@pytest.mark.slow
@pytest.mark.parametrize("kind", CHUNKS)
@pytest.mark.parametrize(("rollout", "task"), TASKS)
def test_an_episode_with_an_observation_that_is_nan_is_invalid_and_named_and_no_other_changes(rollout, task, kind):
    sound, faulty = (result_of(rollout, task, kind, fault) for fault in ("none", "nan"))
    start_N = sound.of_steps["observation"][::STEPS, 0]
    is_bad_N = start_N < 0.0
    assert 0 < np.count_nonzero(is_bad_N) < is_bad_N.size
    for name in ("fitness", "returns"):
        found_N, wanted_N = getattr(faulty, name).ravel(), getattr(sound, name).ravel()
        np.testing.assert_array_equal(np.isnan(found_N), is_bad_N)
        if rollout == "xla":  # another program may have other last bits
            np.testing.assert_allclose(found_N[~is_bad_N], wanted_N[~is_bad_N], rtol=1e-5)
        else:
            np.testing.assert_array_equal(found_N[~is_bad_N], wanted_N[~is_bad_N])
    np.testing.assert_array_equal(faulty.steps, sound.steps)
    assert not sound.failures
    said = "nan" if rollout == "host" else "NaN or infinite"
    assert len(faulty.failures) == min(8, np.count_nonzero(is_bad_N))
    assert all(f"observation[{BAD}] of step 4 is {said}" in text for text in faulty.failures)
    first = int(np.argmax(is_bad_N))
    who = {
        "training": f"member {'+-'[first % 2]} of pair {8 + first // 2} ",
        "evaluation": f"evaluation episode {16 + first} ",
        "policies": f"episode {first // 3} of policy {first % 3} ",
    }[kind]
    assert faulty.failures[0].startswith(who)
    if kind == "training":
        assert faulty.moments.count == STEPS * np.count_nonzero(~is_bad_N)


@pytest.mark.slow
@pytest.mark.parametrize(("rollout", "task"), TASKS)
def test_an_infinite_observation_is_valid_only_where_observations_are_clipped(rollout, task):
    """The sensor alternates between both infinities, whose sum is NaN."""
    for kind in ("training", "evaluation"):
        clipped, bare = (result_of(rollout, task, kind, "infinite", clip=clip) for clip in (2.0, None))
        is_bad_N = clipped.of_steps["observation"][::STEPS, 0] < 0.0
        assert np.isfinite(clipped.fitness).all()
        assert not clipped.failures
        np.testing.assert_array_equal(np.isnan(bare.fitness.ravel()), is_bad_N)
        assert f"observation[{BAD}] of the reset is " in bare.failures[0]


@pytest.mark.slow
@pytest.mark.parametrize(("rollout", "task"), TASKS)
def test_what_no_policy_acts_on_does_not_count(rollout, task):
    """Neither what a task returns after its end nor the observation with which it ends."""
    for ends in (3, 4):
        result = result_of(rollout, task, "evaluation", "nan", ends=ends)
        assert np.isfinite(result.fitness).all()
        assert not result.failures
        assert (result.steps == ends).all()


@pytest.mark.slow
@pytest.mark.parametrize(("rollout", "task"), TASKS)
def test_a_reward_that_is_nan_is_named_with_its_step(rollout, task):
    for kind in ("training", "evaluation"):
        result = result_of(rollout, task, kind, "reward")
        assert np.isnan(result.fitness).any()
        assert "the reward of step 4 is " in result.failures[0]
        assert "NaN" in result.failures[0] or "nan" in result.failures[0]


@pytest.mark.slow
@pytest.mark.parametrize(("rollout", "task"), TASKS)
def test_an_infeasible_episode_in_which_an_observation_is_nan_is_invalid(rollout, task):
    result = result_of(rollout, task, "training", "infeasible", infeasible=True)
    is_bad_N = result.of_steps["observation"][::STEPS, 0] < 0.0
    np.testing.assert_array_equal(np.isnan(result.fitness.ravel()), is_bad_N)
    assert f"observation[{BAD}] of step 4 is " in result.failures[0]


@pytest.mark.slow
@pytest.mark.parametrize("task", [f"{__name__}:Sensor", f"python:{__name__}:PythonSensor"])
def test_the_advice_after_nan_names_the_observation_and_the_step(task, tmp_path, one_process):
    notices = []
    config = {
        "task": {"environment": task, "options": {"fault": "nan"}},
        "policy": {"hidden": [4]},
        "search": {"algorithm": "es", "pairs": 8, "evaluation_episodes": 8, "max_invalid_fraction": 0.1},
        "budget": {"generations": 3},
        "compute": {"engine": "inline"},
    }
    with pytest.raises(EvaluationError, match=rf"generation 1: .*observation\[{BAD}\] of step 4 is") as raised:
        api.run(config, out=tmp_path / "run", on_notice=notices.append)
    assert "sigma" not in str(raised.value)
    assert any(f"observation[{BAD}] of step 4 is" in notice for notice in notices)


@pytest.mark.slow
def test_a_task_in_double_precision_runs_with_float32_observations(tmp_path):
    """Its module turns on `jax_enable_x64`, so it is imported in processes of their own only."""
    config = {
        "task": {"environment": "tests.workers.x64_tasks:Cart"},
        "policy": {"hidden": [4]},
        "search": {"algorithm": "es", "pairs": 8, "evaluation_episodes": 4},
        "budget": {"generations": 2},
        "compute": {"engine": "inline", "workers": 1},
    }
    outcome = api.run(config, out=tmp_path / "run")
    assert outcome.run.config["compute"]["rollout"] == "xla"
    assert outcome.run.history["invalid_members"].tolist() == [0, 0, 0]
    assert outcome.run.policy("best")(np.zeros(2, np.float32)).shape == (1,)


@pytest.mark.slow
@pytest.mark.parametrize("task", [f"{__name__}:Failing", f"python:{__name__}:PythonFailing"])
def test_doctor_finds_an_observation_that_is_nan(task):
    *_, (level, text) = task_findings(task)
    assert level == "FAIL"
    assert f"observation[{BAD}] of step 4 is " in text


class Failing(Sensor):
    """a point with a sensor that fails"""

    options = {"fault": ("nan", "none")}  # noqa: RUF012

    def __init__(self, fault="nan"):
        super().__init__(fault)


class PythonFailing(PythonSensor):
    """the same as an object"""

    options = Failing.options

    def __init__(self, fault="nan"):
        super().__init__(fault)
