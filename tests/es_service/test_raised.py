"""Errors in a user's code: first what was raised, with the frames of the user's files; others only in a debug log."""

from __future__ import annotations

import json
import pickle
import re
import subprocess
import sys

import pytest
import yaml

from es_service import api
from es_service.dispatch.events import because
from es_service.dispatch.ray_calls import raised_in_actor
from es_service.errors import ConfigError
from es_service.protocol.user_code import RaisedError, raised, users_error
from tests.system.command_line import PROGRAM, command
from workers.simd.graph.graph import UnsupportedError

TASK = """
import sys

import jax.numpy as jnp

class Up:
    observation_size, action_size, episode_steps = 2, 1, 5
    descriptor_names, descriptor_bounds = ("x",), ((-5.0, 25.0),)
    options = {"way": ("good", "constructor", "step", "worker")}

    def __init__(self, way="good"):
        self.way = way
        if way == "constructor":
            raise ValueError("no such way :smile:")

    def reset(self, key):
        return jnp.zeros(2)

    def observe(self, state):
        return state

    def step(self, state, action):
        is_wrong = self.way == "step" or (self.way == "worker" and sys.argv[0].endswith("process.py"))
        return (helper(state) if is_wrong else state) + action[0], state[0], False

    def descriptor(self, state):
        return state[:1]

def helper(state):
    return state @ jnp.ones((3, 3))
"""
SEARCH = """
from dataclasses import replace
from es_service.search.algorithms import ALGORITHMS

def telling(config):
    return replace(ALGORITHMS["es"](config), tell=tell)

def tell(state, evaluations):
    return state.nothing

def unmade(config):
    return {}["sigma"]


def of_nothing():
    return {}
"""
CONFIG = {
    "task": {"environment": "my_task:Up"},
    "policy": {"hidden": [4]},
    "search": {"algorithm": "es", "pairs": 16, "evaluation_episodes": 2},
    "budget": {"generations": 2},
    "compute": {"engine": "inline", "workers": 1},
}
FOREIGN = re.compile(r"workers/|es_service/[a-z]|site-packages|importlib|Traceback")
"""What is in frames that are not the user's."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("user")
    (made / "my_task.py").write_text(TASK)
    (made / "my_search.py").write_text(SEARCH)
    (made / "typo.py").write_text("import jax\n\ndef f(:\n")
    (made / "missing.py").write_text("\nimport no_such_package\n")
    (made / "c.yaml").write_text(yaml.safe_dump(CONFIG))
    return made


def places(folder, text):
    """The frames in a message, such as "my_task.py, step"; those of a syntax error with the line."""
    found = re.findall(r'File "(.*?)", line (\d+)(?:, in (\S+))?', text)
    return [f"{file.removeprefix(f'{folder}/')}, {name or line}" for file, line, name in found]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("setting", "first", "frames"),
    [
        ("task.options.way=worker", "TypeError: dot_general requires", ["my_task.py, step", "my_task.py, helper"]),
        ("search.algorithm=my_search:telling", "AttributeError: 'SearchState'", ["my_search.py, tell"]),
    ],
)
def test_a_user_s_own_error_comes_first_with_the_frames_of_the_user_s_files(folder, tmp_path, setting, first, frames):
    result = command("run", folder / "c.yaml", "--out", tmp_path / "run", "--set", setting, cwd=folder)
    assert result.returncode == 1
    printed = result.stderr.partition("error: ")[2]
    assert printed.startswith(first)
    assert places(folder, printed) == frames
    assert not FOREIGN.search(printed.replace(str(folder), ""))
    way_out = "to continue (from the last finished|with its first) generation .*resume"
    assert re.search(way_out, printed.splitlines()[-1])


@pytest.mark.parametrize(
    ("setting", "said", "frames"),
    [
        ("task.options.way=constructor", "ValueError: no such way :smile:", ["my_task.py, __init__"]),
        ("task.options.way=step", "TypeError: dot_general requires", ["my_task.py, step", "my_task.py, helper"]),
        ("search.algorithm=my_search:unmade", "my_search:unmade raised KeyError: 'sigma'", ["my_search.py, unmade"]),
        ("search.algorithm=math:sin", "math:sin raised TypeError: must be real number, not RunConfig", []),
        ("search.algorithm=my_search:of_nothing", "raised TypeError: of_nothing() takes 0 positional arguments", []),
        ("task.environment=missing:A", "importing missing raised ModuleNotFoundError", ["missing.py, <module>"]),
        ("task.environment=typo:A", "importing typo raised SyntaxError: invalid syntax", ["typo.py, 3"]),
        ("task.environment=nowhere:A", "cannot import nowhere (No module named 'nowhere'); start in the folder", []),
        ("search.algorithm=typo:f", "importing typo raised SyntaxError: invalid syntax", ["typo.py, 3"]),
        ("search.algorithm=missing:f", "importing missing raised ModuleNotFoundError", ["missing.py, <module>"]),
    ],
)
def test_so_does_an_error_before_the_run(folder, monkeypatch, setting, said, frames):
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder)
    with pytest.raises(ConfigError) as caught:
        api.load_config(CONFIG, [setting])
    printed = str(caught.value)
    assert said in "".join(printed.splitlines()[:2])
    assert places(folder, printed) == frames
    assert not FOREIGN.search(printed.replace(str(folder), ""))


@pytest.mark.slow
@pytest.mark.parametrize(
    "setting",
    [pytest.param("task.options.way=worker", marks=pytest.mark.long), "search.algorithm=my_search:telling"],
)
def test_the_frames_of_the_program_are_in_the_debug_log(folder, tmp_path, setting):
    settings = ("--set", setting, "--set", "compute.dispatch_log=true", "--log-level", "debug")
    words = [PROGRAM, "run", "c.yaml", *settings, "--out", tmp_path / "run"]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    assert re.search(r"DEBUG [^\n]*\n?Traceback", done.stderr.replace("worker 0: ", ""))
    assert FOREIGN.search(done.stderr)
    if "task" in setting:
        log = [json.loads(line) for line in (tmp_path / "run/dispatch.jsonl").read_text().splitlines() if line]
        assert any("workers/episode.py" in entry.get("traceback", "") for entry in log)


def error_of(function):
    try:
        function()
    except Exception as error:
        return error
    raise AssertionError("it raised nothing")


def test_an_error_keeps_its_causes_and_notes():
    def inner():
        raise KeyError("sensor")

    def outer():
        try:
            inner()
        except KeyError as error:
            error.add_note("unplugged")
            raise RuntimeError("no reading") from error

    text = users_error(error_of(outer))
    assert re.search(
        r"^RuntimeError: no reading\n  File (.*\n)*.* in outer\n(.*\n)*caused by KeyError: 'sensor'\n  File", text
    )
    assert text.splitlines()[-1] == "unplugged"


def test_an_error_of_ours_is_its_sentence_and_a_bug_its_whole_traceback():
    bug = error_of(lambda: json.loads("{"))
    bug.__traceback__ = bug.__traceback__.tb_next.tb_next  # without the frames of this file
    assert users_error(bug) == ""
    assert raised(bug).message == raised(bug).traceback
    assert raised(bug).message.startswith("Traceback (most recent call last):")
    assert raised(UnsupportedError("simd cannot do this")).message == "simd cannot do this"


def test_a_package_beside_the_libraries_is_the_user_s_if_it_is_named(tmp_path):
    package = tmp_path / "site-packages"
    package.mkdir()
    (package / "installed.py").write_text("def f():\n    return 1 / 0\n")
    script = (
        f"import sys; sys.path.append({str(package)!r}); import installed\n"
        "from es_service.protocol.user_code import users_error\n"
        "try: installed.f()\n"
        "except ZeroDivisionError as error:\n"
        "    error.__traceback__ = error.__traceback__.tb_next\n"
        "    print(bool(users_error(error)), 'in f' in users_error(error, 'installed:f'))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True"]


def test_an_exception_travels_as_its_texts():
    error = pickle.loads(pickle.dumps(RaisedError("ValueError: no\n  File", "whole")))
    assert (error.message, error.traceback, str(error)) == ("ValueError: no\n  File", "whole", "ValueError: no\n  File")
    assert raised(error) is error
    task_error = RuntimeError("\x1b[36mray::run\x1b[39m")
    assert raised_in_actor(task_error).message == "ray::run"
    task_error.cause = error
    assert raised_in_actor(task_error) is error


def test_a_reason_of_several_lines_comes_first():
    assert because("item a failed", "killed") == "item a failed: killed"
    assert because("item a failed", "ValueError: no\n  File") == "ValueError: no\n  File\nitem a failed"
