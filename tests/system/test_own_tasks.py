"""Whole runs of a task that is not ours, a user's module or Brax's: the same bits on any workers and after a resume."""

from __future__ import annotations

import pytest
import yaml

from es_service import api
from tests.helpers import workers_in_this_process
from tests.system.command_line import digest, es
from tests.system.test_code_identity import REWARD, TASK

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]  # each worker compiles, on a busy machine for half a minute


@pytest.fixture
def run(tmp_path):
    """A function that runs commands in a folder with the user's modules and config, which are found from there only."""
    for name, text in {"my_task.py": TASK, "my_reward.py": REWARD}.items():
        (tmp_path / name).write_text(text)

    def start(task, *words):
        (tmp_path / "my.yaml").write_text(yaml.safe_dump(config_of(task)))
        code, printed = es(*words, cwd=tmp_path)
        assert code == 0, printed

    return start


def config_of(task):
    """A short run of a task."""
    return {
        "task": {"environment": task, "episode_steps": 20},
        "policy": {"hidden": [8]},
        "search": {"algorithm": "es", "pairs": 8, "evaluation_episodes": 4},
        "budget": {"generations": 3},
        "compute": {"chunk_pairs": 2, "gradient_block_pairs": 4, "no_worker_timeout_s": 600},
    }


def test_a_user_s_task(tmp_path, run):
    task, start = "my_task:Point", ("run", "my.yaml", "--out")
    run(task, *start, "ray", "--engine", "ray", "--workers", 1)
    run(task, *start, "resumed", "--engine", "inline", "--workers", 2, "--set", "budget.generations=1")
    run(task, "resume", "resumed", "--workers", 1, "--set", "budget.generations=3")
    assert digest(tmp_path / "resumed") == digest(tmp_path / "ray")


@pytest.mark.long
def test_one_of_brax_s(tmp_path, run):
    """Begun by a worker process, and gone on with in this one, which computes the whole, too."""
    task, inline = "brax:inverted_pendulum", ["compute.engine=inline", "compute.workers=1"]
    start = ("run", "my.yaml", "--engine", "inline", "--workers", 1)
    run(task, *start, "--out", "resumed", "--set", "budget.generations=1")
    with workers_in_this_process():
        api.run(api.load_config(config_of(task), inline), tmp_path / "whole")
        api.resume(tmp_path / "resumed", ["budget.generations=3"])
    assert digest(tmp_path / "resumed") == digest(tmp_path / "whole")
