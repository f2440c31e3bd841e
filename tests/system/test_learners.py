"""Reinforcement learners of others, in an environment of their own, on our tasks: the tests of tests/learners there."""

import os
import subprocess

import pytest

from tests.learners.environment import ROOT, build


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_learners_take_our_tasks():
    command = [build(), "-m", "pytest", "tests/learners", "-q", "-W", "default", "-p", "no:cacheprovider"]
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, "PYTHONPATH": ""}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]
    assert " skipped" not in done.stdout
