"""Which files are the code of a run, and what counts as another version of it."""

from __future__ import annotations

import importlib
import json
import pickle
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from es_service.api import load_config
from es_service.config.tasks import task_of
from es_service.config.workload import worker_spec
from es_service.dispatch.events import Limits
from es_service.dispatch.inline_engine import inline_engine
from es_service.errors import ConfigError, EvaluationError
from es_service.protocol.machine import CODE, architecture, is_mixed, platform_info
from es_service.protocol.messages import TrainingChunk
from es_service.protocol.sources import (
    OtherCodeError,
    driver_sources,
    in_words,
    other_files,
    task_code,
    why_refused,
    worker_sources,
)
from es_service.runs.checked_config import code_of, require_unchanged, tell_of_other_code
from tests.helpers import SPEC, centre, random_parameters
from workers.actor import WorkerActor

ROOT = Path(__file__).parents[2]
WORKERS, DRIVER = worker_sources("point_maze"), driver_sources("es")
PRINT = """
import json
from es_service.protocol.sources import driver_sources, worker_sources
print(json.dumps([worker_sources("point_maze"), driver_sources("es")]))
"""


def test_the_folders_that_compute_count_and_no_others():
    def files(*folders: str) -> set[str]:
        return {str(file.relative_to(ROOT)) for folder in folders for file in (ROOT / folder).rglob("*.py")}

    assert WORKERS.keys() == files("workers", "es_service/protocol")
    assert DRIVER.keys() == files("es_service/loop", "es_service/search", "es_service/config")


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory):
    """Another checkout, and a function that returns what a process there says of its code."""
    folder = tmp_path_factory.mktemp("elsewhere") / "checkout"
    for package in ("es_service", "workers"):
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))

    def said():
        run = subprocess.run(
            [sys.executable, "-c", PRINT], cwd=folder, env={"PYTHONPATH": str(folder)}, capture_output=True, check=True
        )
        return json.loads(run.stdout)

    return folder, said


def test_an_unchanged_checkout_at_another_path_has_the_same_code(elsewhere):
    folder, said = elsewhere
    for file, old, new in (
        ("es_service/cli/common.py", 'help="Change one key', 'help="Set one key'),
        ("es_service/cli/main.py", "import typer\n", "import typer  # a comment\n"),
        ("es_service/api.py", "RUNS_FOLDER", "WHERE_RUNS_ARE"),
        ("es_service/runs/view.py", "import os\n", "import os  # a comment\n"),
    ):
        text = (folder / file).read_text()
        assert old in text
        (folder / file).write_text(text.replace(old, new))
    (folder / "workers/.#policy.py").symlink_to("nowhere")  # left by an editor
    assert said() == [WORKERS, DRIVER]


@pytest.mark.parametrize(
    ("file", "of_workers"),
    [
        ("workers/simd/graph/folding.py", True),
        ("es_service/protocol/noise.py", True),
        ("es_service/search/steps.py", False),
        ("es_service/loop/driver.py", False),
        ("es_service/config/search.py", False),
    ],
)
def test_an_edited_file_is_named_to_the_side_that_computes_with_it(elsewhere, file, of_workers):
    folder, said = elsewhere
    sound = (folder / file).read_bytes()
    (folder / file).write_bytes(sound + b"\nx = 1\n")
    workers, driver = said()
    (folder / file).write_bytes(sound)
    assert other_files(WORKERS, workers) == ([file] if of_workers else [])
    assert other_files(DRIVER, driver) == ([] if of_workers else [file])


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A user's folder: a task with its physics, a search in a package, and modules that neither of them uses."""
    for name, text in {
        "my_task.py": "import json\nimport numpy\n\ndef f():\n    from my_physics import g\n",
        "my_physics.py": "import my_constants\nimport workers.policy\n",
        "my_constants.py": "raise RuntimeError('imported')",
        "my_notes.py": "",
        "my_searches/__init__.py": "",
        "my_searches/first.py": "from . import steps\nfrom .deep.down import h\n",
        "my_searches/steps.py": "",
        "my_searches/deep/__init__.py": "",
        "my_searches/deep/down.py": "from ..extra import e\n",
        "my_searches/extra.py": "",
        "my_searches/second.py": "",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_user_s_modules_count_with_what_they_import_from_the_same_place(own):
    task = worker_sources("my_task:Maze")
    assert set(other_files(WORKERS, task)) == {"my_task.py", "my_physics.py", "my_constants.py"}
    search = driver_sources("my_searches.first:search")
    names = ("__init__", "first", "steps", "extra", "deep/__init__", "deep/down")
    assert set(other_files(DRIVER, search)) == {f"my_searches/{name}.py" for name in names}
    assert not {"my_task", "my_constants", "my_searches"} & sys.modules.keys()
    (own / "my_notes.py").write_text("x = 1")
    assert worker_sources("my_task:Maze") == task
    (own / "my_constants.py").write_text("x = 1")
    assert other_files(task, worker_sources("my_task:Maze")) == ["my_constants.py"]
    (own / "my_physics.py").unlink()
    assert other_files(task, worker_sources("my_task:Maze")) == ["my_constants.py", "my_physics.py"]


def test_a_descriptor_that_is_a_user_s_function_is_code_of_the_task(own):
    name = "gymnasium:Pendulum-v1"
    assert task_code(name, None, {}) == task_code(name, "angle", {}) == task_code(name, (0, 1), {}) == (name,)
    task, without_map = {"environment": name}, {"enabled": False}
    config = load_config(
        {"task": task, "search": {"algorithm": "es"}, "map": without_map, "budget": {"generations": 1}}
    )
    described = config.task.model_copy(update={"descriptor": "my_task:f"})
    code = code_of(config.model_copy(update={"task": described}))
    assert set(other_files(code_of(config), code)) == {"my_task.py", "my_physics.py", "my_constants.py"}
    assert "my_task.py" in other_files(worker_sources(name), worker_sources(*described.code))


def test_the_model_file_of_an_ant_in_mujoco_is_code_of_the_run(tmp_path, monkeypatch):
    """Another version of Gymnasium's package has another `ant.xml`: a worker with it is refused, and a resume tells."""
    assets = Path("gymnasium/envs/mujoco/assets")
    installed = Path(*importlib.import_module("gymnasium").__path__).parent / assets
    shutil.copytree(installed, tmp_path / assets)
    (tmp_path / "gymnasium/__init__.py").touch()
    given = {"task": {"environment": "ant_trap"}, "search": {"algorithm": "es"}, "budget": {"generations": 1}}
    spring, mujoco = (load_config(given, [f"task.options.physics={physics}"]) for physics in ("spring", "mujoco"))
    before = code_of(mujoco)
    assert f"{assets}/ant.xml" in other_files(before, code_of(spring))
    spec = worker_spec(mujoco, task_of(mujoco))
    monkeypatch.delitem(sys.modules, "gymnasium")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert code_of(mujoco) == before, "its place does not count"
    (tmp_path / assets / "ant.xml").write_text("<mujoco/>")
    assert "has other code" in why_refused(spec.sources, spec.task_code)
    assert f"{assets}/ant.xml." in why_refused(spec.sources, spec.task_code)
    then = {**platform_info(), CODE: before}
    store: Any = SimpleNamespace(generation=4, platform_before=lambda generation: then, folder=tmp_path)
    told: list[str] = []
    tell_of_other_code(store, code_of(mujoco), told.append)
    assert told[0].startswith("from generation 5 on, this run is computed with other code: ")
    assert f": {assets}/ant.xml changed. " in told[0]
    with pytest.raises(ConfigError, match=r"strict was asked for.* computed: [^ ]*/ant\.xml\n"):
        require_unchanged(store, mujoco)


@pytest.mark.parametrize("name", ["brax:ant", "no_such_module:Class", "sys:path", "rich.table:Table", "json:loads"])
def test_other_packages_count_by_their_versions(name):
    """An installed package counts if the task itself is in it, but not the packages that are installed beside it."""
    found = worker_sources(name).keys() - WORKERS.keys()
    assert all(file.startswith("rich/") for file in found)
    assert bool(found) == (name == "rich.table:Table")


def test_many_files_are_told_in_few_words():
    assert in_words(["a"]) == "a"
    assert in_words([f"{n}.py" for n in range(7)]) == "0.py, 1.py, 2.py, 3.py, 4.py and 2 others"


OTHER = {**WORKERS, "workers/policy.py": "0" * 32, "workers/gone.py": "0" * 32}


def test_a_worker_with_other_code_names_host_and_files(monkeypatch):
    monkeypatch.setattr("socket.gethostname", lambda: "node-7")
    assert why_refused(WORKERS, ["point_maze"]) == why_refused({}, ["point_maze"], architecture()) == ""
    monkeypatch.setattr("platform.machine", lambda: "arm64")
    assert why_refused({}, ["point_maze"], "aarch64") == ""
    assert "of the architecture aarch64, but compute.platform keeps this run to x86_64" in why_refused(
        {}, ["point_maze"], "x86_64"
    )
    problem = why_refused(OTHER, ["point_maze"])
    assert problem.startswith("node-7 has other code")
    assert "workers/gone.py, workers/policy.py." in problem
    with pytest.raises(OtherCodeError, match=r"node-7 has other code.*workers/policy\.py"):
        WorkerActor(pickle.dumps(replace(SPEC, sources=OTHER)), 0).build()


@pytest.mark.parametrize("threads", [False, True])
def test_a_child_with_other_code_is_refused(threads):
    spec, limits = replace(SPEC, sources=OTHER), Limits(workers=2, restart_backoff_s=0.0)
    with inline_engine(spec, limits, threads=threads) as engine, pytest.raises(EvaluationError) as caught:
        engine.evaluate([(centre(random_parameters()), TrainingChunk(1, 0))])
    assert "has other code than the driver" in str(caught.value)
    assert "workers/gone.py, workers/policy.py" in str(caught.value)


def test_a_worker_of_another_architecture_is_refused():
    other = "aarch64" if architecture() == "x86_64" else "x86_64"
    spec, says = replace(SPEC, platform=other), f"compute.platform keeps this run to {other}"
    with pytest.raises(OtherCodeError, match=says):
        WorkerActor(pickle.dumps(spec), 0).build()
    with (
        inline_engine(spec, Limits(workers=1, restart_backoff_s=0.0)) as engine,
        pytest.raises(EvaluationError, match=says),
    ):
        engine.evaluate([(centre(random_parameters()), TrainingChunk(1, 0))])


def test_other_code_makes_a_run_mixed_and_unknuser_code_does_not():
    old, new, unknown = {"cpu": "a", CODE: {"f": "1"}}, {"cpu": "a", CODE: {"f": "2"}}, {"cpu": "a"}
    assert is_mixed([old, new])
    assert is_mixed([old, unknown, new])
    assert not is_mixed([unknown, old, old])
    assert is_mixed([unknown, {**old, "cpu": "b"}])
