"""Every kind of policy with what is done with a run: it is resumed, verified, replayed, exported and called."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from es_service import api, evaluator
from es_service.config.tasks import TASKS
from es_service.config.workload import policy_spec
from es_service.runs.certification import certify_run
from es_service.runs.certified import Certified
from es_service.runs.export import export
from es_service.runs.replay import record
from es_service.runs.snapshot import Policy
from es_service.runs.verification import verify
from es_service.store.digest import digest_parts

pytestmark = pytest.mark.usefixtures("workers_here")
KINDS = {
    "relu, linear outputs, no biases": {"activation": "relu", "output": "linear", "bias": False},
    "one action": {"output": "argmax"},
    "one action at random": {"output": "categorical"},
    "any action at random": {"output": "gaussian"},
    "a memory": {"memory": 4},
}


def config_of(kind, **more):
    return {
        "task": {"environment": "point_maze", "episode_steps": 25},
        "policy": {"hidden": [6], **KINDS[kind]},
        "search": {"algorithm": "nsr_es", "centres": 2, "pairs": 16, "sigma": 0.2, "evaluation_episodes": 3},
        "map": {"cells": [6, 6]},
        "budget": {"generations": 3},
        "compute": {"engine": "inline", "workers": 1},
    } | more


def certified(folder, search, **sections) -> Certified:
    """The certified policy of an ES with a hidden layer, in 256 episodes."""
    config = sections | {
        "search": {"algorithm": "es", "sigma": 0.1, "evaluation_episodes": 16, **search},
        "map": {"enabled": False},
        "compute": {"engine": "inline", "workers": 1},
    }
    api.run(config, folder)
    return certify_run(folder)[0]


@pytest.mark.slow
def test_a_policy_that_chooses_an_action_balances_a_pole(tmp_path):
    found = certified(
        tmp_path / "run",
        {"pairs": 32, "step": {"kind": "adam", "learning_rate": 0.05, "l2": 0.0}},
        task={"environment": "tests.examples.cart_pole:CartPole"},
        policy={"hidden": [8], "output": "categorical"},
        budget={"env_steps": 800_000},
    )
    assert found.episodes.return_E.mean() > 190.0, "of 200 steps"


@pytest.mark.long
@pytest.mark.parametrize("memory", [16, None])
def test_a_policy_with_a_memory_swings_up_a_pendulum_whose_velocity_is_hidden(tmp_path, memory):
    found = certified(
        tmp_path / "run",
        {"pairs": 128, "step": {"kind": "adam", "learning_rate": 0.03, "l2": 0.0}},
        task={"environment": "tests.examples.swing_up:SwingUp", "episodes_per_member": 2},
        policy={"hidden": [16], "memory": memory, "action_noise": 0.0},
        budget={"env_steps": 20_000_000},
    )
    assert found.episodes.success_E is not None
    swung_up = int(found.episodes.success_E.sum())
    assert swung_up >= 240 if memory else swung_up < 128, "of 256"


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_with_each_kind_of_policy_is_resumed_verified_replayed_exported_and_called(kind, tmp_path):
    run = api.run(config_of(kind), tmp_path / "run").run
    part = api.run(config_of(kind, budget={"generations": 1}), tmp_path / "part").run
    shutil.copytree(part.folder, tmp_path / "killed")
    resumed = api.resume(tmp_path / "killed", ["budget.generations=3"]).run
    assert digest_parts(resumed.folder) == digest_parts(run.folder)
    assert all(not one.differences for one in verify(run, 2, 1))
    place = tuple(int(n) for n in run.map[["cell_x", "cell_y"]].iloc[-1])
    replays, _ = record(run, best=True, cells=[place])
    assert all(one.is_the_stored for one in replays)
    [elsewhere] = certify_run(run.folder, top=0, episodes=16, task="point_maze", on_notice=print)
    assert elsewhere.row()["gap_return_mean"] == 0.0, "it is the run's own task, with the same starts"
    export(run, "npz", tmp_path / "out")
    policy, observations = run.policy("best"), np.array([[0.1, -0.8], [0.3, 0.2]], np.float32)
    act = policy.start()
    first, second = (act(one) for one in observations)
    if KINDS[kind].get("memory"):
        assert not np.array_equal(policy.start()(observations[1]), second), "it remembers the first observation"
    else:
        assert np.array_equal(policy(observations), np.stack([first, second]))


@pytest.mark.parametrize("kind", KINDS)
def test_an_evaluator_runs_each_kind_of_policy_as_it_is_called(kind):
    config = api.load_config(config_of(kind))
    shape = policy_spec(config, TASKS["point_maze"])
    policies = np.random.default_rng(0).normal(size=(3, shape.parameters)).astype(np.float32)
    with evaluator(config, transitions=True) as evaluate:
        found, again = (evaluate(policies, episodes=2, seed=5) for _ in range(2))
    steps = found.transitions
    assert steps is not None
    assert steps.action.tobytes() == again.transitions.action.tobytes()
    assert steps.steps.min() > 1
    zero, one, called = np.zeros(2, np.float32), np.ones(2, np.float32), np.empty_like(steps.action)
    for policy, episode in np.ndindex(3, 2):
        rows, act = steps.rows(policy, episode), Policy(shape, policies[policy], zero, one, None).start()
        called[rows] = [act(seen) for seen in steps.observation[rows]]
    np.testing.assert_allclose(steps.action, called, atol=1e-5, err_msg="an evaluation draws no action")
