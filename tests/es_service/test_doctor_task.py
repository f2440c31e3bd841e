"""`doctor TASK` tells a task that repeats itself from one that does not, and says how fast it is."""

from __future__ import annotations

import json
import re

import jax.numpy as jnp
import pytest
from typer.testing import CliRunner

from es_service import api
from es_service.cli.doctor import task_findings
from es_service.cli.main import app
from es_service.errors import ConfigError
from es_service.protocol.noise import uniforms
from es_service.runs.checked_config import load_config

MODULE = "tests.workers.host_tasks"


def findings(name):
    return list(task_findings(name))


@pytest.mark.parametrize(
    ("name", "unit"),
    [(f"python:{MODULE}:Drift", "steps"), ("function:tests.workers.functions:hill", "calls")],
)
def test_a_task_that_repeats_is_said_to(name, unit, monkeypatch):
    monkeypatch.setattr("es_service.cli.doctor.SECONDS", 0.01)
    (_, what), _, (level, repeats), (_, speed) = findings(name)
    assert what.startswith(f"{name}: A ")
    assert level == "ok"
    assert repeats.startswith("it repeats bit for bit")
    assert "in another process" in repeats
    assert re.match(rf"[\d,]+ {unit}/s on one core", speed)


class Misnamed:
    """a point stays where it is, and its walls have another name"""

    observation_size = action_size = 1
    episode_steps = 3
    descriptor_names, descriptor_bounds = ("x",), ((0.0, 1.0),)
    wals = (((0.0, 0.0), (1.0, 0.0)),)

    def reset(self, key):
        return uniforms(key, jnp.zeros(1, jnp.uint32))

    def observe(self, state):
        return state

    def step(self, state, action):
        return state, state[0], False

    def descriptor(self, state):
        return state


@pytest.mark.slow
def test_what_has_no_effect_is_noted_and_a_run_notes_it_once(tmp_path, one_process):
    name, notices = f"{__name__}:Misnamed", []
    (note,) = (sentence for level, sentence in findings(name) if level == "note")
    assert note.startswith(f"{name}: wals has no effect")
    settings = {
        "task": {"environment": name},
        "policy": {"hidden": []},
        "search": {"algorithm": "es", "pairs": 4, "evaluation_episodes": 1},
        "budget": {"generations": 1},
        "compute": {"engine": "inline", "workers": 1, "rollout": "simd"},
    }
    folder = api.run(settings, tmp_path / "run", on_notice=notices.append).run.folder
    assert notices == [note]
    api.resume(folder, {"budget.generations": 2}, on_notice=notices.append)
    assert notices == [note]


class Still(Misnamed):
    """a point stays where it is; its episodes differ in nothing but their number of steps"""

    descriptor_names, descriptor_bounds = ("steps",), ((0.0, 3.0),)

    def descriptor(self, state):
        return jnp.full(1, 3.0)


class FromZero(Still):
    """a point begins at 0 and moves by its action, which is 0 there for a policy without biases"""

    def reset(self, key):
        return jnp.zeros(1)

    def step(self, state, action):
        return state + action, state[0], False

    def descriptor(self, state):
        return state


@pytest.mark.long
def test_a_descriptor_that_is_the_same_in_all_episodes_is_noted_also_by_a_run_that_needs_it(tmp_path, one_process):
    def told(search, generations=21, environment=f"{__name__}:Still"):
        notices: list[str] = []
        settings = {
            "task": {"environment": environment},
            "policy": {"hidden": []},
            "search": {"evaluation_episodes": 1, **search},
            "budget": {"generations": generations},
            "compute": {"engine": "inline", "workers": 1, "rollout": "xla"},
        }
        api.run(settings, tmp_path / f"{search['algorithm']}_{environment}_{generations}", on_notice=notices.append)
        return [notice for notice in notices if "wals" not in notice]

    [said] = (sentence for level, sentence in findings(f"{__name__}:Still") if "descriptor was the same" in sentence)
    assert said.startswith("the descriptor was the same in 8 episodes of random policies: steps = 3. ")
    for other in ("Misnamed", "FromZero"):
        assert not any("the same in" in sentence for _, sentence in findings(f"{__name__}:{other}"))
    novelty, elites = {"algorithm": "ns_es", "pairs": 4}, {"algorithm": "map_elites", "batch": 4}
    for search in (novelty, elites):
        [notice] = told(search)
        assert notice.startswith("the descriptor was the same in all evaluations of 20 generations: steps = 3. ")
        assert told(search, 19) == []
        assert told(search, environment=f"{__name__}:Misnamed") == []
    assert told({"algorithm": "es", "pairs": 4}) == []


@pytest.mark.slow
def test_what_simd_would_hide_is_a_failure_and_refused_before_a_run():
    name = "tests.workers.simd.test_trial:HiddenReward"
    ((_, failure),) = ((level, sentence) for level, sentence in findings(name) if level == "FAIL")
    assert failure.startswith("its reward is NaN in step 1 with actions of 0: what ")
    with pytest.raises(ConfigError, match=r"HiddenReward: its reward is NaN .*test_trial.py:.* multiplies it by 0"):
        load_config({"task": {"environment": name}, "search": {"algorithm": "es"}, "budget": {"generations": 1}})


@pytest.mark.slow
def test_tasks_that_do_not_repeat_are_told_from_one_that_does_with_what_mends_it(monkeypatch):
    monkeypatch.setattr("es_service.cli.doctor.SECONDS", 0.01)
    forgetful, fragile = (f"python:{MODULE}:{name}" for name in ("Forgetful", "Fragile"))
    *_, (level, repeats), (_, mended), _ = findings(forgetful)
    assert level == "note"
    assert "it returns other numbers after another episode, so" in repeats
    assert "With task.new_object_each_episode=true each episode has a new object, and it repeats bit for bit" in mended
    result = CliRunner().invoke(app, ["doctor", fragile, f"python:{MODULE}:Drift", "--json"])
    assert result.exit_code == 1
    said = [(finding["level"], finding["text"]) for finding in json.loads(result.stdout)]
    assert any(level == "FAIL" and fragile in text and "the fifth step cannot be done" in text for level, text in said)
    assert any("it repeats bit for bit" in text for _, text in said)


def test_a_function_that_ends_its_process_is_named_with_its_parameters_and_what_it_has_printed():
    *_, (level, failure) = findings("function:tests.workers.functions:doomed")
    assert level == "FAIL"
    assert re.search(
        r"its process ended with exit code 3:\nsingular matrix\n.* width = 0\.5, with the seeds 1 and 2", failure
    )


def test_tasks_in_jax_repeat_and_what_is_no_task_is_named():
    assert findings("point_maze")[-1][1].startswith("its steps are pure functions")
    with pytest.raises(ConfigError, match=r"point_mase is not a known task; .*did you mean point_maze\?"):
        findings("point_mase")
