"""Learners of others, in environments of their own, on our tasks: the tests of tests/learners there."""

import os
import subprocess

import pytest

from tests.learners.environment import ENVIRONMENTS, ROOT, build

OF_QDAX = "tests/learners/test_qdax.py"


@pytest.mark.long
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_learners_take_our_tasks(name):
    where = {"qdax": [OF_QDAX], "learners": ["tests/learners", f"--ignore={OF_QDAX}"]}[name]
    patient = ["--timeout", "1800"]  # on a busy machine, XLA compiles for minutes
    command = [build(name), "-m", "pytest", *where, *patient, "-q", "-W", "default", "-p", "no:cacheprovider"]
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, "PYTHONPATH": ""}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]
    assert " skipped" not in done.stdout
