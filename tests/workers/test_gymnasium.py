"""Tasks that are environments of Gymnasium: their episodes are those of a loop written by hand."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from es_service import api, load_config
from es_service.config.tasks import TASKS, task_of
from es_service.config.text import parse_value
from es_service.config.workload import policy_spec
from es_service.errors import ConfigError
from es_service.protocol.messages import EvaluationChunk, HostChoices
from es_service.protocol.noise import evaluation_reset_keys
from es_service.protocol.options import defaults_of
from es_service.protocol.sources import user_path, user_sources
from es_service.runs.replay import record
from es_service.runs.snapshot import Policy
from tests.helpers import centre, random_parameters, spec
from tests.workers.gymnasium_environments import Reach
from workers.environments import TaskError, describe_environment, gymnasium_task, make_host_task
from workers.environments.host_task import HostEnvironment
from workers.worker import make_worker

MODULE = "tests.workers.gymnasium_environments"
REACH = f"gymnasium:{MODULE}:tests/Reach-v0"
CLASSIC = {
    "CartPole-v1": (4, 2, 500, True),
    "Pendulum-v1": (3, 1, 200, False),
    "MountainCarContinuous-v0": (2, 1, 999, False),
    "Acrobot-v1": (6, 3, 500, True),
    "MountainCar-v0": (2, 3, 200, True),
    "FrozenLake-v1": (16, 4, 100, True),
    "Swimmer-v5": (8, 2, 1000, False),
}
"""Environment -> sizes of observation and action, steps, whether actions are to be chosen from."""


def config_of(environment, **task):
    return {
        "task": {"environment": environment, "episode_steps": 20} | task,
        "policy": {"hidden": [8]},
        "search": {"algorithm": "es", "pairs": 16, "evaluation_episodes": 3, "sigma": 0.3},
        "map": {"enabled": False},
        "budget": {"generations": 2},
        "compute": {"engine": "inline", "workers": 1},
    }


WHOLE = np.iinfo(np.int64)


@pytest.mark.parametrize(
    "space",
    [
        gymnasium.spaces.Box(-0.1, 0.1, (3,), np.float64),
        gymnasium.spaces.Box(-0.7, np.inf, (3,), np.float64),
        gymnasium.spaces.Box(-2, 3, (3,), np.int64),
        gymnasium.spaces.Box(0, 255, (3,), np.uint8),
        gymnasium.spaces.Box(WHOLE.min, WHOLE.max, (3,), np.int64),
    ],
    ids=str,
)
def test_actions_are_in_the_space_and_reach_its_bounds(space):
    action_L_A = np.linspace(-1.3, 1.3, 3 * 401, dtype=np.float32).reshape(-1, 3)
    taken = gymnasium_task._acted("task", space)(action_L_A)
    assert all(space.contains(one) for one in taken)
    assert (np.diff(taken.reshape(-1).astype(np.float64)) >= 0).all()
    for found, bound in ((taken.min(), space.low[0]), (taken.max(), space.high[0])):
        assert np.isinf(bound) or float(found) == pytest.approx(float(bound), rel=1e-15)
    if space.dtype == np.int64 and space.high[0] == 3:
        values, counts = np.unique(taken[np.abs(action_L_A) < 1.0], return_counts=True)
        assert values.tolist() == [-2, -1, 0, 1, 2, 3]
        assert np.ptp(counts[1:-1]) <= 1


@pytest.mark.parametrize("name", CLASSIC)
def test_episodes_are_those_of_a_loop_by_hand(name):
    """With the environment as Gymnasium makes it, with its checks and its limit, and actions by its spaces."""
    task = describe_environment(f"gymnasium:{name}")
    assert (task.observation_size, task.action_size, task.episode_steps, task.discrete_actions) == CLASSIC[name]
    steps = min(task.episode_steps, 210)
    config = load_config(config_of(task.name, episode_steps=steps))
    shape = policy_spec(config, task)
    assert shape.output == ("argmax" if task.discrete_actions else "tanh")
    worker_spec = spec(
        environment=task.name,
        environment_options=defaults_of(task.options),
        episode_steps=steps,
        policy=shape,
        rollout="host",
    )
    subject = centre(random_parameters(2, shape.parameters), observation_size=task.observation_size)
    [found] = make_worker(worker_spec)([(subject, EvaluationChunk(4, 0, episodes=3))])
    policy = Policy(shape, subject.parameters_D, subject.observation_mean_O, subject.observation_std_O, 5.0)
    with gymnasium.make(name) as environment:
        space = environment.action_space
        for episode in range(3):
            seed = int(evaluation_reset_keys(3, 4, episode)[0]) >> 1
            seen, _ = environment.reset(seed=seed)
            total, count, ended = 0.0, 0, False
            while not ended and count < steps:
                if isinstance(environment.observation_space, gymnasium.spaces.Discrete):
                    seen = np.eye(task.observation_size)[seen]
                action = policy(seen)
                if isinstance(space, gymnasium.spaces.Discrete):
                    action = np.argmax(action)
                else:
                    action = space.low + (action + 1.0) / 2.0 * (space.high - space.low)
                seen, reward, terminated, truncated, _ = environment.step(action)
                total, count, ended = total + reward, count + 1, terminated or truncated
            assert count == found.steps[episode] == found.descriptor[episode, 0]
            np.testing.assert_allclose(found.fitness[episode], total, rtol=1e-5)


@pytest.mark.usefixtures("one_process")
@pytest.mark.parametrize(
    "name",
    [
        "CartPole-v1",
        *(
            pytest.param(name, marks=pytest.mark.long)
            for name in ("Acrobot-v1", "Pendulum-v1", "MountainCar-v0", "MountainCarContinuous-v0")
        ),
    ],
)
def test_classic_environments_are_searched(name, tmp_path):
    run = api.run(config_of(f"gymnasium:{name}", episode_steps=50), tmp_path / "run").run
    assert np.isfinite(run.history.best_fitness).all()
    assert run.history.invalid_members.sum() == 0
    found = run.policy("best")(np.zeros(run.policy_spec.widths[0]))
    assert found.shape == (CLASSIC[name][1],)


def test_an_episode_of_a_vector_entry_point_depends_on_how_many_are_beside_it():
    """The reason why the rollout does not use it; if this changes, it could."""
    first = [gymnasium.make_vec("CartPole-v1", num_envs=count).reset(seed=3)[0][0] for count in (2, 3)]
    assert gymnasium.spec("CartPole-v1").vector_entry_point is not None
    assert not np.array_equal(*first)


@pytest.mark.parametrize(
    ("descriptor", "names", "bounds"),
    [
        ([1, 0], ("observation_1", "observation_0"), ((-2.0, 2.0),) * 2),
        pytest.param("place", ("place_0", "place_1"), ((-1e30, 1e30),) * 2, marks=pytest.mark.long),
        (f"{MODULE}:turning", ("rewards", "places"), ((-60.0, 0.0), (-60.0, 60.0))),
        pytest.param(None, ("length",), ((0.0, 25.0),), marks=pytest.mark.long),
    ],
)
def test_a_config_chooses_the_descriptor(descriptor, names, bounds, tmp_path, one_process):
    """A key of info that the reset lacks is known from the first step on, in traces and replays, too."""
    config = config_of(REACH, descriptor=descriptor)
    config["map"] = {"cells": [5] * len(names)} | ({"bounds": [[-2, 2], [-2, 2]]} if descriptor == "place" else {})
    task = task_of(load_config(config))
    assert (task.descriptor_names, task.descriptor_bounds) == (names, bounds)
    assert task.success == "the info of the last step has a true is_success"
    run = api.run(config, tmp_path / "one").run
    found = run.map[list(names)].to_numpy()
    assert np.isfinite(found).all()
    if descriptor is None:
        assert (found == 20.0).all()
        return
    [replay], recordings = record(run, best=False, cells=[run.map[[f"cell_{one}" for one in names]].iloc[0].tolist()])
    assert replay.is_the_stored
    seen_T_B = recordings.recordings[0].descriptor_T_B
    assert np.isfinite(seen_T_B).all()
    if descriptor == "place":
        np.testing.assert_array_equal(seen_T_B[0], seen_T_B[1])
        other = api.run(config | {"task": config["task"] | {"descriptor": [0, 1]}}, tmp_path / "two").run
        np.testing.assert_array_equal(found, other.map[["observation_0", "observation_1"]].to_numpy())
        with pytest.raises(ConfigError, match=r"map.bounds: missing, since the descriptor of .* has no bounds"):
            load_config(config | {"map": {}})


@pytest.mark.usefixtures("one_process")
def test_options_are_arguments_of_make_and_constants_of_the_run(tmp_path):
    config = config_of(REACH, options={"reach": 0.5, "limit": 7})
    task = task_of(load_config(config))
    assert {name: option.default for name, option in task.options.items()} == {"reach": 0.2, "limit": 7}
    run = api.run(config, tmp_path / "run").run
    assert run.config["task"]["options"] == {"reach": 0.5, "limit": 7}
    assert run.history.env_steps.iloc[-1] == 7 * (3 * 3 + 2 * 32), "the environment truncates after the limit"
    resumed = api.resume(tmp_path / "run", ["budget.generations=3"]).run
    whole = api.run(config | {"budget": {"generations": 3}}, tmp_path / "whole").run
    assert resumed.digest() == whole.digest()
    with pytest.raises(ConfigError, match=r"cannot be made with the options .*unexpected keyword argument 'reech'"):
        load_config(config_of(REACH, options={"reech": 0.5}))


@pytest.mark.slow
def test_lists_and_mappings_are_arguments_and_keep_their_values(tmp_path):
    given = {"goal": [0.5, [1, None, "x"]], "scales": {"x": 2.0, "far": {"y": [1]}, "none": {}}}
    name = f"gymnasium:{MODULE}:tests/Told-v0"
    config = load_config(config_of(name, options=given))
    assert config.task.options == {"size": 2, **given}
    run = api.run(config, tmp_path / "run").run
    assert run.config["task"]["options"] == config.task.options
    assert {key: run.constants[f"task.options.{key}"] for key in given} == given
    assert load_config(parse_value((tmp_path / "run" / "config.yaml").read_text())) == config
    assert api.resume(tmp_path / "run", ["budget.generations=3"]).run.generation == 3
    with pytest.raises(ConfigError, match=r"task\.options\.goal: \[0\.5, \[1, null, x\]\] -> \[2\]"):
        api.resume(tmp_path / "run", ["task.options.goal=[2]"])
    other = api.fork(
        tmp_path / "run", ["task.options.scales={z: 1}", "budget.generations=4"], out=tmp_path / "fork"
    ).run
    assert other.config["task"]["options"] == {"size": 2, "goal": given["goal"], "scales": {"z": 1}}


@pytest.mark.slow
def test_arguments_whose_defaults_are_no_plain_values_are_known_and_left_to_the_environment():
    name = f"gymnasium:{MODULE}:tests/Told-v0"
    task = describe_environment(name)
    assert {key: option.default for key, option in task.options.items()} == {"size": 2, "goal": None, "scales": None}
    assert load_config(config_of(name)).task.options == {"size": 2}
    for wrong, problem in (
        (
            {"goal": [float("nan")]},
            r"task\.options\.goal: \[\.nan\] is not allowed; must be true or false, a finite number",
        ),
        ({"gaol": [1.0]}, r"cannot be made with the options \{'gaol': \[1\.0\]\}: TypeError: .*'gaol'"),
        ({"size": [2]}, r"task\.environment: .* cannot be made with the options \{'size': \[2\]\}: TypeError"),
        (
            {"goal": [0.5, "here"]},
            r"task\.environment: .* cannot do a step with the options .*'here'\]\}: TypeError: must",
        ),
    ):
        with pytest.raises(ConfigError, match=problem):
            load_config(config_of(name, options=wrong))


@pytest.mark.slow
def test_hopper_has_the_arguments_that_it_has():
    pytest.importorskip("mujoco")
    hopper = {"healthy_z_range": [0.7, 2.0], "width": 64}  # the second of them is one of the class that it derives from
    assert load_config(config_of("gymnasium:Hopper-v5", options=hopper)).task.options.items() >= hopper.items()
    with pytest.raises(
        ConfigError, match=r"task\.environment: .* \{'healthy_z_range': \[0\.7\]\}: ValueError: not enough"
    ):
        load_config(config_of("gymnasium:Hopper-v5", options={"healthy_z_range": [0.7]}))


def test_an_argument_that_a_run_decides_is_refused_with_the_key_that_does():
    options = {"max_episode_steps": 100, "disable_env_checker": True}
    with pytest.raises(ConfigError) as caught:
        load_config(config_of("gymnasium:CartPole-v1", options=options))
    (problem,) = caught.value.problems
    assert (problem.field, problem.value) == ("task.options.max_episode_steps", 100)
    assert (
        "max_episode_steps = 100: the length of an episode is the key task.episode_steps; set that" in problem.sentence
    )
    assert "disable_env_checker = True: the checks that Gymnasium adds to each step are left out" in problem.sentence


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("gymnasium:CartPol-v1", r"is not registered in Gymnasium .*; did you mean gymnasium:CartPole-v1\?"),
        (
            f"gymnasium:{MODULE}:tests/Words-v0",
            r"has observations of the space Text.*; Box, Discrete, .* are supported",
        ),
        (f"gymnasium:{MODULE}:tests/Pairs-v0", r"has actions of the space MultiDiscrete.*; Box and Discrete are"),
        (f"gymnasium:{MODULE}:tests/Parts-v0", r"the order leg, pose, are .* task.options.flatten_observation=true"),
        (
            "gymnasium:FetchReach-v4",
            "is not registered .* a module registers it, name this module: gymnasium:MODULE:FetchReach-v4",
        ),
        (f"gymnasium:{MODULE}:tests/Unseen-v0", "has observations of the space Box.*, which are empty"),
        (f"gymnasium:{MODULE}:tests/Still-v0", "has actions of the space Box.*, which are empty"),
        ("gymnasium:no_such_module:Name-v0", "no_such_module"),
    ],
)
def test_what_cannot_be_a_task_is_named(name, problem):
    with pytest.raises(TaskError, match=problem):
        describe_environment(name)


PARTS = f"gymnasium:{MODULE}:tests/Parts-v0"
FLATTENED = {"options": {"flatten_observation": True}}


def test_the_parts_of_an_observation_are_flattened_in_the_order_of_their_sorted_keys():
    task = task_of(load_config(config_of(PARTS, descriptor=[7], **FLATTENED)))
    assert (task.observation_size, task.descriptor_bounds) == (8, ((-2.0, 2.0),))
    environment, by_hand = HostEnvironment(make_host_task(PARTS, FLATTENED["options"])), Reach()
    (x,), (y,) = by_hand.reset(seed=3)[0]
    far = [float(number < -0.5) for number in (x, y)]
    assert environment.reset(3).tolist() == pytest.approx([1, 0, 0, 0.25, *far, x, y])
    (x,), (y,) = by_hand.step(np.array([[0.1, 0.2]]))[0]
    far = [float(number < -0.5) for number in (x, y)]
    assert environment.step(np.array([[0.1, 0.2]]))[0].tolist() == pytest.approx([0, 1, 0, 0.25, *far, x, y])
    with pytest.raises(ConfigError, match=r"flatten_observation = true: .* has observations of one part"):
        load_config(config_of(REACH, **FLATTENED))


def test_a_config_chooses_the_key_of_info_that_says_whether_an_episode_has_succeeded():
    assert task_of(load_config(config_of(PARTS, **FLATTENED))).success == ""
    task = task_of(load_config(config_of(PARTS, success="arrived", **FLATTENED)))
    assert task.success == "the info of the last step has a true arrived"
    assert not task.notes
    environment = HostEnvironment(make_host_task(PARTS, FLATTENED["options"], HostChoices(success="arrived")))
    environment.reset(3)
    near = []
    for _ in range(25):
        place_2 = environment.step(np.array([[0.1, 0.1]]))[0][-2:]
        near.append(bool(np.abs(place_2 - 1.0).max() < 0.2))
        assert environment.success() is near[-1]
    assert {*near} == {False, True}
    (note,) = task_of(load_config(config_of(PARTS, success="there", **FLATTENED))).notes
    assert "task.success = there: the info of the first steps has arrived; without this key, no" in note


@pytest.mark.parametrize(
    ("descriptor", "problem"),
    [
        ([2], "observations of .* have 2 numbers, which are named 0 to 1"),
        ("speed", r"the info of .* has is_success, place after 20 steps"),
        (f"{MODULE}:nothing", "has no function nothing"),
    ],
)
def test_a_descriptor_that_there_is_not_is_named(descriptor, problem):
    with pytest.raises(ConfigError, match=problem):
        load_config(config_of(REACH, descriptor=descriptor))
    with pytest.raises(
        ConfigError, match=r"task.descriptor: .* is not allowed for point_maze, whose descriptor is its own"
    ):
        load_config(config_of("point_maze", descriptor=descriptor))


def test_the_code_of_an_environment_is_its_module_and_the_library_s_version():
    assert user_path("gymnasium:Ant-v5") == ""
    assert user_path("gymnasium:my_package/My-v0") == "my_package:My-v0"
    assert user_path("gymnasium:my_package.inner:other/My-v0") == "my_package.inner:other/My-v0"
    assert user_sources("gymnasium:Ant-v5") == {"gymnasium": gymnasium.__version__}
    assert "tests/workers/gymnasium_environments.py" in user_sources(REACH)
    assert TASKS[REACH].summary == "Reach of Gymnasium"
