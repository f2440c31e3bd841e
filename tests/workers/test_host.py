"""Tasks of Python objects: the rollout `host`, whose workers import no JAX, keeps every promise of the others."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from es_service import api, certify, certify_run, evaluator, load_config
from es_service.cli.main import app
from es_service.config.tasks import TASKS, task_of
from es_service.dispatch.events import Limits
from es_service.dispatch.inline_engine import inline_engine
from es_service.errors import ConfigError, EvaluationError
from es_service.protocol.episodes import AT_THE_END, OF_STEPS
from es_service.protocol.messages import NO_CHOICES, EvaluationChunk, HostChoices, PolicySpec, Report, TrainingChunk
from es_service.protocol.noise import (
    NORMAL_STD,
    Domain,
    evaluation_reset_keys,
    normal_integers,
    stream_keys,
    uniforms,
)
from es_service.protocol.options import defaults_of
from es_service.protocol.policies import Policies, PolicyChunk
from es_service.runs.engine import dispatch_limits
from es_service.runs.replay import record
from tests.helpers import centre, inline_here, random_parameters, spec, workers_in_this_process
from tests.system.processes import is_running
from tests.workers import host_tasks
from workers.describe import does_not_repeat, examine
from workers.environments import TaskError, describe_environment, make_host_task
from workers.environments.gymnasium_task import KeyedGenerator
from workers.environments.host_task import HostEnvironment, unchanged
from workers.host.episodes import EnvironmentPool
from workers.policy import LanePolicies
from workers.worker import make_worker

MODULE = "tests.workers.host_tasks"
MAZE, DRIFT = f"python:{MODULE}:CornerMaze", f"python:{MODULE}:Drift"
ES = {"algorithm": "es", "pairs": 16, "sigma": 0.1, "evaluation_episodes": 3}
MAP_ELITES = {"algorithm": "map_elites", "batch": 20, "centres": 3, "iso_sigma": 0.2}


def config_of(environment, search=ES, **compute):
    return {
        "task": {"environment": environment, "episode_steps": 30},
        "policy": {"hidden": [8]},
        "search": search,
        "map": {"cells": [8, 8] if environment != DRIFT else [16]},
        "budget": {"generations": 4},
        "compute": {"engine": "inline", "workers": 2} | compute,
    }


def test_a_generator_draws_the_variates_of_its_key_one_after_another():
    key = stream_keys(1, Domain.OTHER_TASK_RESET, 2, 3)
    drawn, at = KeyedGenerator(key), np.arange(20, dtype=np.uint32)
    u, z = uniforms(key, at).astype(float), normal_integers(np, key, at) / NORMAL_STD
    np.testing.assert_array_equal(drawn.uniform(-1.0, 1.0, size=3), 2.0 * u[:3] - 1.0)
    assert drawn.uniform(2.0, 4.0) == 2.0 + 2.0 * u[3]
    np.testing.assert_array_equal(drawn.standard_normal((2, 2)), z[4:8].reshape(2, 2))
    np.testing.assert_array_equal(drawn.normal([1.0, 2.0], 0.5), [1.0, 2.0] + 0.5 * z[8:10])
    np.testing.assert_array_equal(drawn.uniform(low=[0.0, 1.0, 2.0], high=3.0), u[10:13] * [3, 2, 1] + [0, 1, 2])
    assert drawn.random() == u[13]
    assert drawn.normal() == z[14]
    others = [(one.integers(1000), one.random(2, np.float32).tolist()) for one in (KeyedGenerator(key), drawn)]
    assert others[0] == others[1], "they depend on the key alone"


@pytest.mark.slow
@pytest.mark.parametrize("search", [ES, pytest.param(MAP_ELITES, marks=pytest.mark.long)], ids=["es", "map_elites"])
def test_a_run_and_its_replays_are_those_of_simd(search, tmp_path, request):
    """PointMaze from its corner, whose reset draws nothing."""
    of_simd = config_of("point_maze", search, rollout="simd")
    of_simd["task"]["options"] = {"start": "corner"}
    if search is ES:
        of_simd["compute"]["chunk_pairs"] = 8
    of_simd["compute"]["workers"] = 1
    with workers_in_this_process():
        simd = api.run(of_simd, tmp_path / "simd").run
    request.getfixturevalue("no_jax")
    run = api.run(config_of(MAZE, search), tmp_path / "host").run
    assert run.config["compute"]["rollout"] == "host"
    for column in ("best_fitness", "env_steps", "coverage", "goal_distance_min", "population_return_median"):
        np.testing.assert_allclose(run.history[column], simd.history[column], rtol=2e-3, err_msg=column)
    np.testing.assert_allclose(run.policy("best").parameters_D, simd.policy("best").parameters_D, atol=1e-3)
    cells = list(run.map[["cell_x", "cell_y"]].head(2).itertuples(index=False, name=None))
    replays, recordings = record(run, best=True, cells=cells)
    assert [one.is_the_stored for one in replays] == [True] * (1 + len(cells))
    assert len(recordings.recordings[0].descriptor_T_B) == 31


def drift(**changes):
    """A spec of Drift."""
    shape = PolicySpec((3, 8, 1))
    return spec(environment=DRIFT, episode_steps=40, policy=shape, rollout="host", chunk_pairs=4, **changes)


def parameters_of(worker_spec, seed=0):
    return random_parameters(seed, worker_spec.policy.parameters)


def centre_of(worker_spec, **changes):
    return centre(parameters_of(worker_spec), observation_size=3, **changes)


@pytest.mark.slow
def test_of_what_a_simulator_prints_the_newest_is_kept_and_told_when_its_worker_is_killed():
    """2 MB a chunk, of which 100 kB may stay; by child processes."""
    loud = replace(drift(), environment=f"python:{MODULE}:Loud", output_bytes=100_000)
    subject, patience_s = centre_of(loud), time.monotonic() + 20.0
    with inline_engine(loud, Limits(workers=1)) as engine:
        for chunk in range(4):
            engine.evaluate([(subject, TrainingChunk(1, chunk))])
        log = engine.transport._workers[0].child._log.fileno()
        while os.fstat(log).st_size > 75_000:
            assert time.monotonic() < patience_s, "8 MB were printed"
            time.sleep(0.02)
        # Not at its end: a line that is written while the file is cut may come before older ones.
        assert re.search(r"joint limit reached\nstep \d+ is done\n?", engine.transport.kill(0))


@pytest.mark.parametrize(
    "policy",
    [
        PolicySpec((3, 8, 1)),
        PolicySpec((3, 8, 1), memory=4),
        PolicySpec((3, 1), output="gaussian", bias=False),
        PolicySpec((3, 5, 1), activation="relu", output="linear"),
    ],
    ids=repr,
)
def test_an_episode_depends_on_its_address_and_its_policy_alone(policy):
    """Not on its slot, on the others of its chunk, or on what its environment has done before."""
    worker_spec = replace(drift(), policy=policy)
    run = make_worker(worker_spec)
    parameters_N_D = np.stack([parameters_of(worker_spec, seed) for seed in range(5)])
    mean_N_O, std_N_O = np.full((5, 3), 0.1, np.float32), np.full((5, 3), 1.5, np.float32)

    def policies(first, rows, episodes=2):
        return Policies(first, episodes, 3, True, parameters_N_D[rows], mean_N_O[rows], std_N_O[rows])

    [together] = run([(policies(0, slice(0, 5)), PolicyChunk(7, 0))])
    for row in range(5):
        [alone] = run([(policies(row, slice(row, row + 1)), PolicyChunk(7, row))])
        for name in ("fitness", "descriptor", "steps"):
            np.testing.assert_array_equal(getattr(alone, name), getattr(together, name)[row::5], err_msg=name)
        np.testing.assert_array_equal(alone.trace_T_B, together.trace_T_B[row : row + 1])
    assert len(np.unique(together.fitness)) == 10


def test_members_are_the_centre_and_its_noise_with_the_action_noise_of_their_address():
    """Each member once more by itself: its parameters, its resets and its actions."""
    worker_spec = drift(action_noise=0.3, episodes_per_member=2, observation_clip=2.0)
    subject, chunk = centre_of(worker_spec, sigma=0.4), TrainingChunk(5, 1)
    [result] = make_worker(worker_spec)([(subject, chunk)])
    count, total = worker_spec.policy.parameters, 0
    fitness_P_S, sums = np.zeros((4, 2)), []
    for p in range(4):
        noise_D = normal_integers(
            np, stream_keys(3, Domain.PARAMETER_NOISE, 5, 4 + p), np.arange(count, dtype=np.uint32)
        ).astype(np.float32)
        for s, sign in enumerate((1.0, -1.0)):
            member_D = subject.parameters_D + np.float32(sign) * (np.float32(0.4 / NORMAL_STD) * noise_D)
            for episode in range(2):
                reset_key, action_key = stream_keys(
                    3, (Domain.TRAINING_RESET, Domain.ACTION_NOISE), 5, 4 + p, 0, episode
                )
                ((_, environment),) = EnvironmentPool(make_host_task(DRIFT, {"wind": 0.05})).of([0])
                policy = LanePolicies(
                    worker_spec, member_D[None], subject.observation_mean_O, subject.observation_std_O, action_key[None]
                )
                seen_O, done, step = environment.reset(int(reset_key[0]) >> 1), False, 0
                while not done and step < 40:
                    sums.append(seen_O)
                    action_1_A = policy(seen_O[None], step)
                    noise = normal_integers(np, action_key, np.array([step], np.uint32))[0] / NORMAL_STD
                    quiet = LanePolicies(
                        worker_spec, member_D[None], subject.observation_mean_O, subject.observation_std_O
                    )(seen_O[None], step)
                    np.testing.assert_allclose(action_1_A, quiet + 0.3 * noise, rtol=1e-5, atol=1e-6)
                    action = np.clip(0.5 + action_1_A[0], -0.5, 1.5)
                    seen_O, reward, done = environment.step(action)
                    fitness_P_S[p, s] += reward / 2
                    step += 1
                total += step
    np.testing.assert_allclose(result.fitness, fitness_P_S, rtol=1e-4)
    assert result.steps.sum() == total == result.moments.count == len(sums)
    np.testing.assert_allclose(result.moments.mean_O, np.mean(sums, axis=0), rtol=1e-4)
    np.testing.assert_allclose(result.moments.m2_O, np.var(sums, axis=0) * len(sums), rtol=1e-3)


def test_only_the_episodes_that_are_wanted_are_computed():
    worker_spec = drift(outputs=("success", "last_reward"))
    [three] = make_worker(worker_spec)([(centre_of(worker_spec), EvaluationChunk(2, 0, episodes=3))])
    [every] = make_worker(worker_spec)([(centre_of(worker_spec), EvaluationChunk(2, 0))])
    assert three.fitness.shape == (3,)
    assert every.fitness.shape == (16,)
    np.testing.assert_array_equal(three.fitness, every.fitness[:3])
    np.testing.assert_array_equal(three.trace_T_B, every.trace_T_B)
    np.testing.assert_array_equal(every.trace_T_B[-1], every.descriptor[0])
    np.testing.assert_array_equal(every.outputs["success"], np.abs(every.descriptor[:, 0]) < 0.1)
    np.testing.assert_allclose(every.outputs["last_reward"], -np.abs(every.descriptor[:, 0]), rtol=1e-6)


@pytest.mark.parametrize("episodes", [1, 2])
def test_outputs_of_steps_are_what_happened_in_training_and_in_evaluations(episodes):
    names = (*AT_THE_END, *OF_STEPS)
    worker_spec = drift(outputs=names, episodes_per_member=episodes, action_noise=0.2)
    for chunk in (TrainingChunk(1, 0), EvaluationChunk(1, 0, episodes=5)):
        [found] = make_worker(worker_spec)([(centre_of(worker_spec, sigma=0.5), chunk)])
        steps, total = found.of_steps, found.steps.sum()
        assert {name: len(array) for name, array in steps.items()} == dict.fromkeys(OF_STEPS, total)
        place_K = steps["observation"][:, 0]
        starts_K = steps["observation"][:, 2] == 0.0
        assert starts_K.sum() == (8 * episodes if isinstance(chunk, TrainingChunk) else 5)
        if starts_K.sum() == len(found.outputs["first_observation"]):
            np.testing.assert_array_equal(found.outputs["first_observation"], steps["observation"][starts_K])
        np.testing.assert_array_equal(steps["step_descriptor"][:-1, 0][~starts_K[1:]], place_K[1:][~starts_K[1:]])
        np.testing.assert_allclose(steps["reward"], -np.abs(steps["step_descriptor"][:, 0]), rtol=1e-6)
        np.testing.assert_array_equal(steps["done"], np.abs(steps["step_descriptor"][:, 0]) > 3.0)
        np.testing.assert_allclose(
            steps["reward"].sum(), found.returns.sum() * (episodes if starts_K.sum() > 5 else 1), rtol=1e-4
        )
        moved_K = steps["step_descriptor"][:, 0] - place_K + 0.05
        pushed_K = 0.3 * np.clip(0.5 + steps["action"][:, 0], -0.5, 1.5)
        assert np.abs(moved_K - pushed_K).max() < 0.05 * 6
    with pytest.raises(ValueError, match="no output of episodes has the name 'nothing'"):
        make_worker(drift(outputs=("nothing",)))([(centre_of(worker_spec), EvaluationChunk(1, 0))])


@pytest.mark.slow
@pytest.mark.usefixtures("no_jax")
@pytest.mark.parametrize(
    "fault",
    [
        "",
        "hang",
        pytest.param("exit", marks=pytest.mark.long),
        pytest.param("it raises this once", marks=pytest.mark.long),
    ],
)
def test_workers_a_resume_and_faults_change_no_bit(fault, tmp_path, monkeypatch):
    monkeypatch.setenv("HOST_FAULT", str(tmp_path / "fault"))
    slow = f"python:{MODULE}:Slow"
    config = config_of(slow, ES | {"pairs": 24})
    config["map"] = {"cells": [16]}
    undisturbed = api.run(config | {"compute": {"workers": 1}}, tmp_path / "one").run.digest()
    if not fault:
        three = api.run(config | {"compute": {"workers": 3}}, tmp_path / "three").run
        assert three.digest() == undisturbed
        api.run(config | {"budget": {"generations": 2}}, tmp_path / "two")
        assert api.resume(tmp_path / "two", ["budget.generations=4"]).run.digest() == undisturbed
        return
    (tmp_path / "fault").write_text(fault)
    if fault == "hang":
        config["task"]["time_limit_s"] = 1.0
    notices: list[str] = []
    run = api.run(config, tmp_path / "faulty", on_notice=notices.append).run
    lost, retries = run.history[["lost_workers", "retries"]].sum()
    assert retries > 0
    assert (lost, len(notices)) == (0, 0) if fault == "it raises this once" else (1, 1), notices
    if fault == "hang":
        assert "within 1 s of computing (task.time_limit_s)" in notices[0]
        assert not is_running((tmp_path / "fault_process").read_text()), "what it has started ends with it"
    assert run.digest() == undisturbed


def test_what_an_object_has_started_ends_with_a_driver_that_is_killed(tmp_path):
    (tmp_path / "fault").write_text("hang")
    config = config_of(f"python:{MODULE}:Slow", workers=1) | {"map": {"cells": [16]}}
    program = f"from es_service import api; api.run({config!r}, {str(tmp_path / 'run')!r})"
    environment = os.environ | {"HOST_FAULT": str(tmp_path / "fault")}
    driver = subprocess.Popen([sys.executable, "-c", program], env=environment, stderr=subprocess.DEVNULL)
    file, until = tmp_path / "fault_process", time.monotonic() + 120
    try:
        while not (file.exists() and file.read_text()):
            assert time.monotonic() < until
            time.sleep(0.05)
    finally:
        driver.kill()
        driver.wait()
    while is_running(file.read_text()):
        assert time.monotonic() < until
        time.sleep(0.05)


def test_what_cannot_be_computed_is_named_with_its_seed_so_that_it_can_be_run_alone(tmp_path):
    config = config_of(f"python:{MODULE}:Fragile", max_attempts=1, workers=1) | {"map": {"cells": [16]}}
    with pytest.raises(EvaluationError, match="ValueError: the fifth step cannot be done") as caught:
        api.run(config, tmp_path / "run")
    step, seed = re.findall(r"raised in step (\d+) of the episode whose reset has the seed (\d+)", str(caught.value))[0]
    assert int(step) == 5
    assert int(seed) == int(evaluation_reset_keys(0, 0, 0)[0]) >> 1
    assert re.search(r"its policy has 41 parameters, \S+, .*\nraised in evaluation episode 0, in ", str(caught.value))


@pytest.mark.usefixtures("one_process")
def test_episodes_whose_rewards_are_no_numbers_are_named(tmp_path, caplog):
    config = config_of(f"python:{MODULE}:Undefined", ES | {"max_invalid_fraction": 1.0}, workers=1)
    config["map"] = {"cells": [16]}
    notices: list[str] = []
    run = api.run(config, tmp_path / "run", on_notice=notices.append).run
    texts = [one.getMessage() for one in caplog.records if " failed: " in one.getMessage()]
    of_members = [
        one for one in texts if re.search(r"member [+-] of pair \d+ \(seed \d+\): the reward of step 5 is nan", one)
    ]
    assert 0 < len(of_members) <= run.history.invalid_members.sum()
    assert len(notices) == 1
    seeds = {int(seed) for seed in re.findall(r"\(seed (\d+)\)", "".join(of_members))}
    keys = [stream_keys(0, Domain.TRAINING_RESET, generation, np.arange(16), 0, 0) for generation in range(1, 5)]
    assert seeds <= {int(word) >> 1 for word in np.concatenate(keys)[:, 0]}


def test_a_reward_that_is_none_is_named(tmp_path):
    config = config_of(f"python:{MODULE}:Wordless", max_attempts=1, workers=1) | {"map": {"cells": [16]}}
    with pytest.raises(EvaluationError, match=r"step returned the reward None; it must be a number\nraised in step 7 "):
        api.run(config, tmp_path / "run")


def test_environments_that_end_their_worker_each_time_are_named_with_their_seeds(tmp_path):
    config = config_of(f"python:{MODULE}:Deadly", max_attempts=1, workers=1) | {"map": {"cells": [16]}}
    with pytest.raises(
        EvaluationError, match=r"The resets of its episodes have the seeds (\d+), (\d+), (\d+)"
    ) as caught:
        api.run(config, tmp_path / "run", on_notice=[].append)
    assert "the licence has expired" in str(caught.value)
    seeds = re.findall(r"have the seeds (\d+), (\d+), (\d+)$", str(caught.value), re.MULTILINE)[0]
    assert [int(seed) for seed in seeds] == [int(evaluation_reset_keys(0, 0, one)[0]) >> 1 for one in range(3)]


def test_a_task_says_what_it_is():
    task = TASKS[DRIFT]
    assert (task.kind, task.observation_size, task.action_size, task.episode_steps) == ("python", 3, 1, 40)
    assert task.options["wind"].default == 0.05
    assert task.success == "the info of the last step has a true is_success"
    assert TASKS[MAZE].success == "The point is in the goal square"
    assert TASKS[MAZE].has_goal
    config = load_config(config_of(DRIFT), ["task.options.wind=0.2"])
    assert config.compute.rollout == "host"
    assert config.compute.chunk_pairs == 8
    assert task_of(config).descriptor_names == ("place",)
    assert dispatch_limits(config).late_factor == np.inf, "an object may have effects outside of its process"


@pytest.mark.parametrize(
    ("overrides", "problem"),
    [
        (["compute.rollout=xla"], "xla cannot run .*: it computes tasks in JAX, and not tasks of Python objects"),
        (
            ["task.environment=point_maze", "compute.rollout=host"],
            "it computes tasks of Python objects and functions of parameters, and not tasks in",
        ),
        (["compute.engine=ray", "compute.worker_resources.gpu=1"], "host runs only on CPUs"),
        (["task.options.wind=-1"], "must be a number, at least 0"),
        (["policy.output=argmax"], "whose action is one number"),
    ],
)
def test_what_a_config_cannot_have_is_named(overrides, problem):
    with pytest.raises(ConfigError, match=problem):
        load_config(config_of(DRIFT), overrides)


class Chooser:
    """One of three numbers is to be chosen."""

    observation_size, action_size, episode_steps = 1, 3, 5
    discrete_actions = True

    def reset(self, seed):
        self.wanted = seed % 3
        return self.wanted

    def step(self, action):
        reward, self.wanted = float(action == self.wanted), (self.wanted + 1) % 3
        assert type(action) is int
        return self.wanted, reward, False


def test_actions_to_choose_from_are_numbers_and_a_task_without_a_descriptor_has_its_length():
    name = f"python:{__name__}:Chooser"
    task = describe_environment(name)
    assert (task.discrete_actions, task.descriptor_names, task.descriptor_bounds) == (True, ("length",), ((0.0, 5.0),))
    settings = {"task": {"environment": name}, "search": ES, "budget": {"generations": 1}}
    config = load_config(settings)
    assert (config.policy.output, config.policy.action_noise) == ("argmax", 0.0)
    assert load_config(settings, ["policy.output=categorical"]).policy.output == "categorical"
    with pytest.raises(
        ConfigError, match=r"policy.output: tanh is not allowed .*one of 3 to choose from; must be argmax"
    ):
        load_config(settings, ["policy.output=tanh"])
    for output in ("argmax", "categorical"):
        worker_spec = spec(
            environment=name,
            episode_steps=5,
            policy=PolicySpec((1, 8, 3), output=output),
            action_noise=0.0,
            rollout="host",
            chunk_pairs=8,
        )
        subject = centre(random_parameters(1, worker_spec.policy.parameters), observation_size=1, sigma=1.0)
        [found] = make_worker(worker_spec)([(subject, TrainingChunk(1, 0))])
        assert 0.0 < found.fitness.mean() < 5.0
        assert (found.descriptor == 5.0).all()


RESET = r"reset\(seed\) must start an episode that depends only on the seed, and return an observation of 3 numbers, or"
STEP = (
    r"step\(action\) must do one step, and return \(observation, reward, done\), or \(observation, reward, terminated"
)


@pytest.mark.parametrize(
    ("name", "value", "problem"),
    [
        ("observation_size", 4, "an observation has 3 numbers, not 4"),
        ("observation_size", 4.0, "observation_size = 4.0 is not of type int"),
        ("episode_steps", 0, "episode_steps = 0 is not positive"),
        ("action_bounds", (1.0, -1.0), r"action_bounds: \(1.0, -1.0\) is not a pair"),
        ("action_bounds", ((0.0, 1.0),) * 2, "action_bounds has 2 pairs, but action_size is 1"),
        ("discrete_actions", True, "action_bounds = .* has no meaning with discrete_actions"),
        ("descriptor_bounds", ((0.0, 1.0),) * 2, "1 descriptor_names but 2 descriptor_bounds"),
        ("descriptor", lambda self: [1.0, 2.0], "the descriptor has 2 numbers, not 1"),
        ("step", lambda self, action: (0.0, 1.0), rf"step returned 2 values; {STEP}"),
        ("step", lambda self: ([0.0] * 3, 1.0, False), rf"step takes \(\) and not an action; {STEP}"),
        ("step", lambda self, action: None, rf"step returned None \(is a `return` missing\?\); {STEP}"),
        (
            "step",
            lambda self, action: ([0.0] * 3, 1.0, np.array([False, True])),
            rf"done = array\(.*not one bool \(or 0 or 1\); {STEP}",
        ),
        (
            "step",
            lambda self, action: ([0.0] * 3, False, 1.0),
            rf"returned the reward False and done = 1.0 \(are the two swapped\?\); {STEP}",
        ),
        (
            "step",
            lambda self, action: ([0.0] * 3, 1.0, np.nan),
            rf"returned done = nan, which is not one bool .*; {STEP}",
        ),
        ("step", lambda self, action: ([0.0] * 3, False, -0.5, False, {}), r"terminated = -0.5 \(are the two swapped"),
        ("step", lambda self, action: ([0.0] * 3, 0, -0.5), "returned done = -0.5, which is not one bool"),
        (
            "step",
            lambda self, action: ([0.0] * 3, 1.0, False, None, {}),
            rf"truncated = None .*, which is not one.*{STEP}",
        ),
        ("step", lambda self, action: (None, 1.0, False), rf"step returned the observation None .*; {STEP}"),
        ("reset", lambda self: [0.0] * 3, rf"reset takes \(\) and not an argument named seed; {RESET}"),
        ("reset", lambda self, rng_seed: [0.0] * 3, rf"reset takes \(rng_seed\) and not an argument.*; {RESET}"),
        (
            "reset",
            lambda self, seed: None,
            rf"reset returned the observation None \(is a `return` missing\?\); {RESET}",
        ),
        (
            "reset",
            lambda self, seed: [np.zeros(1), np.zeros(2)],
            rf"reset returned the observation \[array.*\]; {RESET}",
        ),
        ("reset", lambda self, seed: {"angle": 0.0}, rf"reset returned the observation {{'angle': 0.0}}; {RESET}"),
        (
            "reset",
            lambda self, seed: np.full(99, "x"),
            rf"reset returned the observation array\(.{{80,90}} \.\.\.; {RESET}",
        ),
        ("descriptor", lambda self: None, r"the descriptor is None \(is a `return` missing\?\); it must be 1 number$"),
        (
            "goal_distance",
            lambda self: None,
            r"goal_distance is None \(is a `return` missing\?\); it must be 1 number$",
        ),
        ("goal_distance", lambda self: [0.0, 1.0], "goal_distance has 2 numbers, not 1"),
        ("success", lambda self: None, r"success is None \(is a `return` missing\?\); it must be one bool"),
        ("step", lambda self, action: 1 / 0, "cannot do a step: ZeroDivisionError"),
        ("step", None, f"step is no method, but None; {STEP}"),
        ("step", lambda self, action: ([0.0] * 3, 1.0, False, False, None), "step returned the info None; it must be"),
        ("reset", lambda self, seed: ([0.0] * 3, None), "reset returned the info None; it must be a mapping"),
        ("options", {"wind": 3}, "option 'wind' = 3 is neither an Option nor a tuple"),
    ],
)
def test_a_class_that_contradicts_itself_is_refused(name, value, problem, monkeypatch):
    monkeypatch.setattr(host_tasks.Drift, name, value, raising=False)
    with pytest.raises(TaskError, match=rf"^{DRIFT}.*{problem}") as caught:
        describe_environment(DRIFT)
    assert "host_task.py" not in str(caught.value)


def test_one_end_may_be_a_bool_or_a_number_of_any_library(monkeypatch):
    for end in (True, np.True_, 1, np.array(True), np.array([1.0])):
        monkeypatch.setattr(host_tasks.Drift, "step", lambda self, action, end=end: ([0.0] * 3, 1.0, end))
        environment = HostEnvironment(make_host_task(DRIFT, {}))
        environment.reset(0)
        assert environment.step(0.0)[2] is True, end


def test_a_new_object_for_each_episode_carries_nothing_over_and_old_ones_are_closed():
    """An object that goes on with the random numbers of the episode before has other numbers only with one object."""
    name, closed = f"python:{host_tasks.__name__}:Forgetful", []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(host_tasks.Forgetful, "close", lambda closing: closed.append(closing), raising=False)
        for is_new in (False, True):
            environment = HostEnvironment(make_host_task(name, {}, HostChoices(new_objects=is_new)))
            first, _, again = environment.reset(1), environment.step(0.3 * np.ones(1)), environment.reset(1)
            assert np.array_equal(first, again)
            steps = [environment.step(0.3 * np.ones(1))[0]]
            alone = HostEnvironment(make_host_task(name, {}))
            alone.reset(1)
            assert np.array_equal(steps[0], alone.step(0.3 * np.ones(1))[0]) is is_new
            assert len(closed) == is_new


@pytest.mark.slow
def test_workers_that_leak_are_replaced_and_what_they_print_is_seen_and_no_bit_changes(tmp_path):
    config = config_of(f"python:{MODULE}:Leaky") | {"map": {"enabled": False}}
    notices, lines, digests = [], [], set()
    for count in (None, 40):
        given = load_config(config, {"task.recycle_after_episodes": count})
        run = api.run(given, tmp_path / str(count), on_notice=notices.append, on_output=lines.append).run
        digests.add(run.digest())
        assert run.history.lost_workers.sum() == run.history.retries.sum() == 0
    assert len(digests) == 1
    (notice,) = notices
    assert re.match(r"worker \d is replaced by a new process, since it has computed \d+ episodes \(task\.", notice)
    assert all(re.fullmatch(r"worker \d+: reset with \d+", line) for line in lines)
    assert len({line.partition(":")[0] for line in lines}) > 2
    shown = CliRunner().invoke(app, ["status", str(tmp_path / "40")]).stdout
    assert re.search(r"newest lines .* printed:\n  worker \d+: reset with \d+\n", shown)
    api.resume(tmp_path / "40", {"task.recycle_after_episodes": 1000, "budget.generations": 5})


def test_all_that_computes_tells_what_its_workers_print(tmp_path, monkeypatch):
    def printing(*given, on_report, **others):
        on_report("worker 0", Report("a limit was reached", ""))
        return inline_here(*given, **others)

    monkeypatch.setattr("es_service.runs.engine.inline_engine", printing)
    lines, folder = [], str(tmp_path / "run")

    def printed():
        told = lines.copy()
        lines.clear()
        assert set(told) <= {"worker 0: a limit was reached"}
        return len(told)

    search = {"algorithm": "es", "pairs": 2, "evaluation_episodes": 2}
    config = load_config(
        config_of(DRIFT, search, workers=1), {"budget.generations": 2, "budget.target_certified": -1e6}
    )
    api.run(config, folder, on_output=lines.append)
    assert printed() == 2, "a session, and the certification of its best centre"
    certify_run(folder, top=0, episodes=2, on_output=lines.append)
    certify(np.zeros((1, 41)), config, episodes=2, on_output=lines.append)
    assert printed() == 2
    with evaluator(config, on_output=lines.append) as evaluate:
        assert (evaluate.parameters, printed()) == (41, 1)
    for computing in (["evaluate"], ["evaluate", "--certify", "--top=0", "--episodes=2"], ["verify"]):
        silent, telling = (CliRunner().invoke(app, [*computing, folder, *shown]) for shown in ([], ["--show-output"]))
        assert silent.exit_code == telling.exit_code == 0
        assert "a limit was reached" not in silent.output + telling.stdout
        assert "worker 0: a limit was reached\n" in telling.stderr


@pytest.mark.parametrize("is_new", [False, True])
def test_chunks_of_objects_that_carry_something_over_have_the_same_bits_in_any_order_if_objects_are_new(is_new):
    task = TASKS[f"python:{MODULE}:Forgetful"]
    worker_spec = spec(
        environment=task.name,
        environment_options=defaults_of(task.options),
        choices=HostChoices(new_objects=is_new),
        policy=PolicySpec((3, 4, 1)),
        episode_steps=10,
        rollout="host",
    )
    subject = centre(random_parameters(0, worker_spec.policy.parameters), observation_size=3)
    first, second = ((subject, EvaluationChunk(1, number, episodes=2)) for number in range(2))
    [one, other], [later, sooner] = make_worker(worker_spec)([first, second]), make_worker(worker_spec)([second, first])
    assert np.array_equal(one.fitness, sooner.fitness) is is_new
    assert np.array_equal(other.fitness, later.fitness) is is_new


class Aliased(host_tasks.Drift):
    """Its descriptor is an array that it goes on changing, and it changes its actions."""

    descriptor_size = 1

    def reset(self, seed):
        self.far = np.zeros(1, np.float32)
        return super().reset(seed)

    def step(self, action):
        np.clip(action, -0.25, 0.25, out=action)
        self.far += 1.0
        return super().step(action)

    def descriptor(self):
        return self.far


def test_arrays_of_the_object_are_copied_and_it_gets_arrays_of_its_own():
    environment = HostEnvironment(make_host_task(f"python:{__name__}:Aliased", {}))
    environment.reset(0)
    seen = []
    for _ in range(3):
        environment.step(np.float32([0.1]))
        seen.append(environment.descriptor())
    assert np.concatenate(seen).tolist() == [1.0, 2.0, 3.0]
    given = np.full((2, 1), 0.9, np.float32)
    for action in unchanged(given):
        environment.step(action)
    assert (given == np.float32(0.9)).all()


class Halving(host_tasks.Drift):
    """It halves its action in place."""

    action_bounds = None

    def step(self, action):
        action *= 0.5
        return super().step(action)


def test_a_task_that_changes_its_actions_in_place_repeats_itself():
    name = f"python:{__name__}:Halving"
    task = describe_environment(name)
    assert len(set(examine(task, {}, NO_CHOICES, 0.0).hashes.values())) == 1
    assert does_not_repeat(task, {}) == ""


def test_a_constructor_must_not_change_what_a_run_takes_from_the_class(monkeypatch):
    monkeypatch.setattr(host_tasks.Drift, "__init__", lambda self, wind: setattr(self, "episode_steps", 7))
    with pytest.raises(TaskError, match=rf"^{DRIFT}: its constructor changes episode_steps \(40 -> 7\)"):
        describe_environment(DRIFT)


@pytest.mark.parametrize("name", ["python:no_such:Class", f"python:{MODULE}:Nothing", "python:pathlib:Path"])
def test_what_is_no_task_is_named(name):
    with pytest.raises(TaskError, match=r"cannot import no_such|has no class Nothing|has no observation_size"):
        describe_environment(name)
