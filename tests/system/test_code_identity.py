"""A run that is continued with other code: a notice, the digest, `--strict`; runs that did not record their code."""

from __future__ import annotations

import json
import shutil
import sys

import pytest

from es_service import api
from es_service.cli.common import command
from es_service.errors import ConfigError
from es_service.protocol.machine import CODE
from es_service.protocol.sources import sha256
from es_service.runs import evaluation
from es_service.store.codec import text_sha256
from es_service.store.digest import checked_parts
from es_service.store.reader import read_platforms
from tests.database import database
from tests.system.command_line import es
from tests.system.session import SMALL

TASK = '''
import jax.numpy as jnp
from my_reward import reward

class Point:
    """a point moves in a square"""

    observation_size = action_size = 2
    episode_steps = 10
    descriptor_names = ("x", "y")
    descriptor_bounds = ((-1.0, 1.0), (-1.0, 1.0))

    def reset(self, key):
        return jnp.zeros(2)

    def observe(self, state):
        return state

    def step(self, state, action):
        state = jnp.clip(state + 0.1 * action, -1.0, 1.0)
        return state, reward(state), jnp.array(False)

    def descriptor(self, state):
        return state
'''
REWARD = "def reward(state):\n    return state[0]\n"
SEARCH = """
from es_service.search.algorithms.nsra_es import ns_es

def search(config):
    return ns_es(config)
"""


@pytest.fixture
def extra(tmp_path, monkeypatch):
    """The folder of a user with a task and a search, and a function that runs and then continues a run with them."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for name, text in {"my_task.py": TASK, "my_reward.py": REWARD, "my_search.py": SEARCH, "my_notes.py": ""}.items():
        (tmp_path / name).write_text(text)
    config = SMALL | {
        "task": {"environment": "my_task:Point"},
        "search": {"algorithm": "my_search:search", "pairs": 16, "evaluation_episodes": 4},
    }

    def go_on(generations, **options):
        told = []
        if (tmp_path / "run").exists():
            api.resume("run", {"budget.generations": generations}, on_notice=told.append, **options)
        else:
            api.run(config | {"budget": {"generations": generations}}, "run", on_notice=told.append)
        return told

    yield tmp_path, go_on
    for name in ("my_search", "my_version"):
        sys.modules.pop(name, None)


def test_a_task_and_a_search_that_are_edited_between_stop_and_resume(extra):
    folder, go_on = extra
    assert go_on(1) == []
    (folder / "my_notes.py").write_text("not imported")
    assert go_on(2, strict=True) == []
    assert checked_parts(folder / "run")[1] is False

    (folder / "my_reward.py").write_text(REWARD.replace("state[0]", "state[1]"))
    (folder / "my_search.py").write_text(f"{SEARCH}# a comment\n")
    before = (folder / "run/config.yaml").read_text()
    code, printed = es("resume", "run", "--set", "budget.generations=3", "--strict", cwd=folder)
    assert code == 2
    assert "my_reward.py, my_search.py" in printed
    assert f"{command('resume', 'run')}\n" in printed
    assert (folder / "run/config.yaml").read_text() == before

    (notice,) = go_on(3)
    assert "from generation 3 on" in notice
    assert "other code: my_reward.py, my_search.py changed" in notice
    assert [first for first, _ in read_platforms(folder / "run")] == [0, 3]
    assert checked_parts(folder / "run")[1] is True
    assert go_on(4, strict=True) == []


EDITED_TASK = TASK.replace("episode_steps = 10", "episode_steps = 5")
LENGTH = """
from dataclasses import replace
from pathlib import Path
import numpy as np
from es_service.search.algorithms.nsra_es import ns_es
from my_version import VERSION

def search(config):
    Path("said").write_text(str(VERSION))
    return replace(ns_es(config), extra={"version": np.asarray(VERSION)})
"""


def hashes(run):
    """File -> recorded hash, of the newest code of a run."""
    return read_platforms(run.folder)[-1][1][CODE]


def test_a_task_that_is_edited_between_two_runs_of_one_process_is_new_in_the_second(extra):
    """With its helper, in all its parts: what the driver knows of it, what workers compute, what is recorded."""
    folder, _ = extra
    config = SMALL | {
        "task": {"environment": "my_task:Point"},
        "search": {"algorithm": "es", "pairs": 16, "evaluation_episodes": 4},
        "budget": {"generations": 1},
    }
    loaded = api.load_config(config)
    first = api.run(config, "first").run
    assert first.history["centre_fitness_mean"].abs().max() <= 10.0

    (folder / "my_task.py").write_text(EDITED_TASK)
    (folder / "my_reward.py").write_text(REWARD.replace("state[0]", "state[0] * 0 + 100"))
    second = api.run(config, "second").run
    assert second.history["centre_fitness_mean"].tolist() == [500.0, 500.0]
    for name in ("my_task.py", "my_reward.py"):
        assert hashes(second)[name] == sha256((folder / name).read_bytes()) != hashes(first)[name]
    with api.evaluator(config) as evaluate:
        assert (evaluate.task.episode_steps, evaluate(evaluate.initial()[None]).fitness.item()) == (5, 500.0)
    best = evaluation.candidates(first, best=True, centre=False, cells=(), every=False)
    (fresh,) = evaluation.evaluate(first, best, 1)
    assert fresh.mean == 1000.0  # the length is a constant of the first run

    for start in (
        lambda: api.run(loaded, "third"),
        lambda: api.run_or_resume(loaded, "third"),
        lambda: api.evaluator(loaded).__enter__(),
        lambda: api.evaluator(loaded, workers=2).__enter__(),
    ):
        with pytest.raises(ConfigError, match=r"has changed since .*\(episode_steps: 10 -> 5\); load") as caught:
            start()
        assert (caught.value.field, (folder / "third").exists()) == ("task.environment", False)
    notices = []
    resumed = api.resume("first", {"budget.generations": 2}, on_notice=notices.append).run
    assert resumed.history["centre_fitness_mean"].tolist()[-1] == 1000.0
    assert "from generation 2 on" in notices[0]
    assert "my_reward.py, my_task.py changed" in notices[0]
    assert hashes(resumed)["my_task.py"] == hashes(second)["my_task.py"]


@pytest.mark.long
def test_a_search_that_is_edited_between_two_runs_of_one_process_is_new_in_the_second(extra):
    """It, or a module that it imports."""
    folder, _ = extra
    files = {"my_search.py": LENGTH, "my_version.py": "VERSION = 1\n"}
    for name, text in files.items():
        (folder / name).write_text(text)
    search = {"algorithm": "my_search:search", "pairs": 16, "evaluation_episodes": 4}
    config = SMALL | {"search": search, "budget": {"generations": 1}}
    loaded = api.load_config(config)
    runs = [api.run(config, "first").run]
    kept = sys.modules["json"], sys.modules[__name__]
    for name, old, new in (("my_version.py", "1", "2"), ("my_search.py", "(VERSION)})", "(VERSION + 1)})")):
        (folder / name).write_text(files[name].replace(old, new))
        runs.append(api.run(loaded, f"after_{name}").run)
        assert hashes(runs[-1])[name] == sha256((folder / name).read_bytes()) != hashes(runs[-2])[name]
    assert [run.at().nodes["extra"]["version"].item() for run in runs] == [1, 2, 3]

    (folder / "my_version.py").write_text("VERSION = 7\n")
    notices = []
    for go_on in (
        lambda: api.resume("first", {"budget.generations": 2}, on_notice=notices.append),
        lambda: api.fork("first", {"budget.generations": 3}, out="fork", on_notice=notices.append),
    ):
        (folder / "said").unlink()
        run = go_on().run
        assert (folder / "said").read_text() == "7"
        assert hashes(run)["my_version.py"] == sha256(b"VERSION = 7\n")
        (folder / "my_version.py").write_text("VERSION = 7\n")
    assert "my_search.py, my_version.py changed" in notices[0]
    assert (sys.modules["json"], sys.modules[__name__]) == kept


@pytest.fixture
def small(finished, tmp_path):
    """A copy of a run of thirty generations, and a function that continues it and returns the notices."""
    shutil.copytree(finished[0], tmp_path / "run")

    def resume(generations, **options):
        told = []
        api.resume(tmp_path / "run", {"budget.generations": generations}, on_notice=told.append, **options)
        return told

    return tmp_path / "run", resume


def forget_the_code(folder):
    """As if a version that did not record code had computed the run."""
    with database(folder / "run.db") as connection:
        for at, text in connection.execute("SELECT generation, platform FROM platform").fetchall():
            fields = json.loads(text)
            del fields[CODE]
            text = json.dumps(fields, sort_keys=True)
            row = (text, text_sha256(f"platform {at}", text), at)
            connection.execute("UPDATE platform SET platform = ?, sha256 = ? WHERE generation = ?", row)


def test_a_run_without_a_record_of_its_code_goes_on_and_has_one_from_then_on(small, monkeypatch):
    folder, resume = small
    forget_the_code(folder)
    with pytest.raises(ConfigError, match="did not record its code") as caught:
        resume(31, strict=True)
    assert (caught.value.field, [way.action for way in caught.value.ways_out]) == ("strict", ["resume"])
    assert resume(31) == []
    assert [CODE in platform for _, platform in read_platforms(folder)] == [False, True]
    assert checked_parts(folder)[1] is False
    assert resume(32, strict=True) == []


def test_strict_also_refuses_other_packages(small, monkeypatch):
    from es_service.runs import checked_config, session

    _, resume = small
    other = {**checked_config.platform_info(), "jax": "99.0"}
    for module in (checked_config, session):
        monkeypatch.setattr(module, "platform_info", lambda: other)
    with pytest.raises(ConfigError, match=r"jax [0-9.]+ -> 99\.0"):
        resume(31, strict=True)
    (notice,) = resume(31)
    assert "from generation 31 on" in notice
    assert "-> 99.0" in notice
    assert "cpu" not in notice


def test_a_fork_with_other_code_is_told_and_marked(small, monkeypatch):
    from es_service.runs import session

    folder, _ = small
    code = dict(session.code_of(api.load_config(SMALL)))
    monkeypatch.setattr(session, "code_of", lambda config: {**code, "es_service/loop/driver.py": "other"})
    told = []
    api.fork(folder, {"budget.generations": 31}, out=folder.parent / "fork", on_notice=told.append)
    assert ["other code: es_service/loop/driver.py changed" in notice for notice in told] == [True]
    assert checked_parts(folder.parent / "fork")[1] is True
    assert checked_parts(folder)[1] is False
