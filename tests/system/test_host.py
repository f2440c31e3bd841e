"""Tasks of Python objects: the driver is killed, workers are Ray's, and a simulator fails on a cluster of hosts."""

from __future__ import annotations

import re
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from es_service import api, evaluator
from es_service.dispatch import waits
from es_service.store.digest import digest_parts
from es_service.store.reader import read_generation
from tests.helpers import workers_in_this_process
from tests.system import cluster
from tests.system.cluster import Cluster
from tests.system.processes import is_running
from tests.system.session import finish
from tests.system.test_cluster import memory_in_use

PROGRAM = Path(sys.executable).parent / "es-service"
MODULE = "tests.workers.host_tasks"
HOST = {
    "task": {"environment": f"python:{MODULE}:Drift"},
    "policy": {"hidden": [4]},
    "search": {"algorithm": "nsra_es", "pairs": 24, "evaluation_episodes": 4, "fitness_weight_patience": 2},
    "map": {"cells": [8]},
    "budget": {"generations": 6},
    "compute": {"engine": "inline", "workers": 1},
}
"""Three training chunks a generation."""
HOOKS = [  # as in test_kill: where a session is killed, at which passage of that point, and the newest generation then
    ("opened", 1, None),
    ("mid_transaction", 2, 0),
    ("after_commit", 3, 3),
    ("before_commit", 2, 4),
]


def with_compute(config: dict, **compute: object) -> dict:
    return config | {"compute": config["compute"] | compute}


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """Digest of the run that nobody disturbs, whose environments are those of this process."""
    folder = tmp_path_factory.mktemp("reference") / "run"
    with workers_in_this_process():
        api.run(api.load_config(HOST), folder)
    return digest_parts(folder)


def test_a_driver_killed_at_each_hook_in_turn_goes_on_to_the_same_bits(tmp_path, reference):
    folder = tmp_path / "run"
    for at, nth, newest in HOOKS:
        config = None if folder.exists() else HOST
        assert finish(folder, config=config, kill={"at": at, "nth": nth}) == -signal.SIGKILL
        assert read_generation(folder) == newest
    assert finish(folder) == 0
    assert digest_parts(folder) == reference


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # Ray leaves files and processes to the garbage collector
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("workers", [1, 2, 3])
def test_workers_of_ray_have_the_bits_of_this_process(workers, tmp_path, reference):
    """One process for each core: an actor of several cores has a child for each."""
    config = with_compute(HOST, engine="ray", workers=workers)
    run = api.run(api.load_config(config), tmp_path / "run", on_notice=pytest.fail).run
    assert run.history.workers.iloc[-1] == workers
    assert digest_parts(run.folder) == reference


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_core_of_an_actor_begins_the_next_work_item_while_the_other_one_computes(tmp_path, monkeypatch):
    """The first two calls are one work item: one waits for a call of the second item, and the other one is done."""
    monkeypatch.setenv("PATIENT_FOLDER", str(tmp_path))
    config = {
        "task": {"environment": "function:tests.workers.functions:patient"},
        "search": {"algorithm": "map_elites", "batch": 4},
        "map": {"bounds": [[-1, 1]]},
        "budget": {"generations": 1},
        "compute": {"engine": "ray", "workers": 2, "worker_resources": {"cpu": 2}},
    }
    with evaluator(config) as evaluate:
        fitness_N_E = evaluate(np.float32([[1.0], [0.0], [-1.0], [0.0]]), episodes=1, seed=0, generation=1).fitness
    np.testing.assert_array_equal(fitness_N_E[:, 0], [1.0, 0.0, -1.0, 0.0])


SURVIVOR = """
import time
from pathlib import Path

import numpy as np


class Drone:
    observation_size, action_size, episode_steps = 3, 1, 10

    def __init__(self):
        time.sleep(0.1 * {times})

    def reset(self, seed):
        self.flies = seed % 4 == 0
        return np.ones(3)

    def step(self, action):
        if self.flies:
            time.sleep(0.1 * {times})
            if Path("hang").exists():
                Path("hang").unlink()
                time.sleep(1000.0)
        return np.ones(3), float(action[0]), not self.flies
"""


@pytest.mark.parametrize(
    ("engine", "times"), [("inline", 1), pytest.param("ray", 4, marks=[pytest.mark.long, pytest.mark.alone])]
)
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_the_first_policy_that_survives_is_no_worker_that_hangs(tmp_path, monkeypatch, engine, times):
    """Its chunk, and making 16 environments, take longer than a worker may say nothing. One that hangs is noticed."""
    (tmp_path / "flight.py").write_text(SURVIVOR.format(times=times))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(waits, "SILENCE_S", 0.3)
    limits = dict.fromkeys(("chunk_timeout_s", "first_chunk_timeout_s", "compile_timeout_s"), 1.5 * times)
    config = {
        "task": {"environment": "python:flight:Drone"},
        "policy": {"hidden": [], "observation_normalization": False},
        "search": {"algorithm": "es", "pairs": 8, "evaluation_episodes": 1},
        "budget": {"generations": 1},
        "compute": {"engine": engine, "workers": 1, "max_attempts": 1} | limits,
    }
    said: list[str] = []
    run = api.run(config, tmp_path / "run", on_notice=pytest.fail, on_compile=said.append).run
    assert run.history.env_steps.iloc[-1] >= 1 + 16 + 2 * 9 + 1, "a pair flies"
    assert any(re.fullmatch(r"making 15 environments: \d+ of 15 \(python:flight:Drone\)", text) for text in said), said
    Path("hang").touch()
    notices: list[str] = []
    run = api.resume(run.folder, ["budget.generations=2", "compute.max_attempts=2"], on_notice=notices.append).run
    assert run.history.lost_workers.tolist() == [0, 0, 1]
    silent = rf"(no progress with|no answer to) work item \S+ 0 of generation \d (for|within) {1.5 * times:g} s"
    assert re.search(silent, notices[0]), notices


FAULTS = {
    "hang": r"lost a worker; .* within 30 s of computing \(task.time_limit_s\)",
    "exit": "lost a worker; ",
    "leak": "lost a worker; .*its node ran out of memory",
    "it raises this once": "",
}
"""Fault of one step of one environment -> what the session prints about it."""


@pytest.mark.long
@pytest.mark.alone  # memory is short meanwhile
@pytest.mark.skipif(cluster.missing() is not None, reason=str(cluster.missing()))
@pytest.mark.parametrize("cores", [1, 2])
def test_a_simulator_that_fails_once_on_a_cluster_of_hosts_changes_no_bit(tmp_path, cores):
    """It hangs, ends its process, takes all the memory that it may have, and raises, one after another in one run. The
    time limit is that of the hang; to take 3 GiB may need ten seconds on a busy machine."""
    config = HOST | {"task": {"environment": f"python:{MODULE}:Slow", "time_limit_s": 30.0}, "map": {"cells": [16]}}
    undisturbed = tmp_path / "undisturbed"
    with workers_in_this_process(), pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOST_FAULT", str(tmp_path / "none"))
        api.run(api.load_config(config), undisturbed)
    file, run, fault = tmp_path / "config.yaml", tmp_path / "run", tmp_path / "fault"
    file.write_text(yaml.safe_dump(with_compute(config, engine="ray")))
    used, total = memory_in_use()
    tight = {"RAY_memory_usage_threshold": f"{(used + 3 * 2**30) / total:.3f}"}
    with Cluster(tmp_path) as hosts:
        for node in ("a", "b"):
            hosts.start(node, cores, HOST_FAULT=str(fault), **tight)

        def session(generations, *command):
            limits = ["--set", f"budget.generations={generations}", "--address", hosts.address]
            # The driver's own trial of the task must not meet the fault before a worker does.
            none = {"HOST_FAULT": str(tmp_path / "none")}
            code, printed = hosts.run("head", PROGRAM, *command, *limits, timeout=600.0, **none)
            assert code == 0, printed
            return printed

        for number, (kind, said) in enumerate(FAULTS.items()):
            fault.write_text(kind)
            printed = session(2 + number, *(("resume", run) if number else ("run", file, "--out", run)))
            assert not fault.exists(), f"no environment has met the fault {kind}"
            assert re.search(said, printed), printed
            if kind == "hang":
                assert not is_running(Path(f"{fault}_process").read_text()), "what it has started ends with it"
        session(6, "resume", run)
    assert digest_parts(run) == digest_parts(undisturbed)


@pytest.mark.long
@pytest.mark.skipif(cluster.missing() is not None, reason=str(cluster.missing()))
def test_a_simulator_that_always_fails_on_a_cluster_ends_with_its_seed(tmp_path):
    config = with_compute(
        HOST | {"task": {"environment": f"python:{MODULE}:Fragile"}, "map": {"cells": [16]}}, engine="ray"
    )
    file = tmp_path / "config.yaml"
    file.write_text(yaml.safe_dump(config))
    with Cluster(tmp_path) as hosts:
        hosts.start("a", 2)
        code, printed = hosts.run(
            "head", PROGRAM, "run", file, "--out", tmp_path / "run", "--address", hosts.address, timeout=600.0
        )
    assert code == 1
    assert "ValueError: the fifth step cannot be done" in printed
    assert "of the episode whose reset has the seed" in printed
    assert "raised in evaluation episode 0, in EvaluationChunk 0 of generation 0" in printed
