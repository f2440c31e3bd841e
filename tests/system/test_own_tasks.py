"""Whole runs of a task that is not ours, a user's module or Brax's: the same bits on any workers and after a resume."""

from __future__ import annotations

import shutil

import pytest
import yaml

from tests.system.command_line import digest, es
from tests.system.processes import ROOT

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]  # each of eight workers compiles for half a minute


@pytest.fixture
def run(tmp_path):
    """A function that runs commands in a folder with the user's module and config, which are found from there only."""
    shutil.copy(ROOT / "tests" / "examples" / "ant_slalom.py", tmp_path / "my_slalom.py")

    def start(task, *words):
        config = {
            "task": {"environment": task, "episode_steps": 20},
            "policy": {"hidden": [8]},
            "search": {"algorithm": "es", "pairs": 8, "evaluation_episodes": 4},
            "budget": {"generations": 3},
            "compute": {"chunk_pairs": 2, "gradient_block_pairs": 4, "no_worker_timeout_s": 600},
        }
        (tmp_path / "my.yaml").write_text(yaml.safe_dump(config))
        code, printed = es(*words, cwd=tmp_path)
        assert code == 0, printed

    return start


def test_a_user_s_task(tmp_path, run):
    task, start = "my_slalom:AntSlalom", ("run", "my.yaml", "--out")
    run(task, *start, "one", "--engine", "inline", "--workers", 1)
    run(task, *start, "two", "--engine", "inline", "--workers", 2)
    run(task, *start, "ray", "--engine", "ray", "--workers", 1)
    run(task, *start, "resumed", "--engine", "inline", "--workers", 1, "--set", "budget.generations=1")
    run(task, "resume", "resumed", "--set", "budget.generations=3")
    assert len({digest(tmp_path / name) for name in ("one", "two", "ray", "resumed")}) == 1


def test_one_of_brax_s(tmp_path, run):
    task, start = "brax:inverted_pendulum", ("run", "my.yaml", "--engine", "inline", "--workers", 1, "--out")
    run(task, *start, "whole")
    run(task, *start, "resumed", "--set", "budget.generations=1")
    run(task, "resume", "resumed", "--set", "budget.generations=3")
    assert digest(tmp_path / "resumed") == digest(tmp_path / "whole")
