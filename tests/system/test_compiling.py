"""Runs of a task that takes long to compile, or to compute: each has a time limit of its own, with a message of its
own."""

from __future__ import annotations

import sys

import pytest

from es_service import api
from es_service.errors import EvaluationError
from tests.dispatch_checker import check_dispatch, read_dispatch_log
from tests.system.session import SMALL

TASK = '''
import time
import jax
import jax.numpy as jnp
import numpy as np

COMPILE_S, COMPUTE_S = {compile_s}, {compute_s}
waited = []

def wait_once(action):
    """Takes long at its first call in a process, like a simulator that loads something."""
    if not waited:
        waited.append(time.sleep(COMPUTE_S))
    return action

class Point:
    """a point moves in a square"""

    observation_size = action_size = 2
    episode_steps = 4
    descriptor_names = ("x", "y")
    descriptor_bounds = ((-1.0, 1.0), (-1.0, 1.0))

    def reset(self, key):
        return jnp.zeros(2)

    def observe(self, state):
        return state

    def step(self, state, action):
        time.sleep(COMPILE_S)  # whenever JAX traces it
        if COMPUTE_S:
            action = jax.pure_callback(wait_once, jax.ShapeDtypeStruct((2,), jnp.float32), action,
                                       vmap_method="expand_dims")
        state = jnp.clip(state + 0.1 * action, -1.0, 1.0)
        return state, state[0], jnp.array(False)

    def descriptor(self, state):
        return state
'''
ENGINES = ["inline", pytest.param("ray", marks=[pytest.mark.long, pytest.mark.alone])]


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A function that runs the task for a few generations."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])

    def start(engine, compile_s=0.0, compute_s=0.0, **compute):
        (tmp_path / "my_task.py").write_text(TASK.format(compile_s=compile_s, compute_s=compute_s))
        config = SMALL | {
            "task": {"environment": "my_task:Point"},
            "budget": {"generations": 2},
            "compute": SMALL["compute"] | {"engine": engine, "rollout": "xla", "dispatch_log": True} | compute,
        }
        return api.run(config, tmp_path / "run", on_notice=pytest.fail).run

    return start


@pytest.mark.parametrize("engine", ENGINES)
def test_a_long_compilation_is_not_taken_for_a_long_chunk(tmp_path, run, engine):
    found = run(engine, compile_s=2.5, first_chunk_timeout_s=2.4, chunk_timeout_s=2.4)
    assert found.history["lost_workers"].sum() == 0
    counts = check_dispatch(tmp_path / "run")
    assert counts["compiled"] == 3
    entries = read_dispatch_log(tmp_path / "run")
    seconds = {entry["kind"]: entry["seconds"] for entry in entries if entry["is"] == "Compiled"}
    assert min(seconds["TrainingChunk"], seconds["EvaluationChunk"]) >= 2.5 > seconds["GradientChunk"]


@pytest.mark.parametrize("engine", ENGINES)
def test_a_compilation_that_takes_too_long_is_said_to_be_one(run, engine):
    with pytest.raises(EvaluationError) as caught:
        run(engine, compile_s=3.0, compile_timeout_s=1.0, max_attempts=1)
    assert "did not finish compiling for work item EvaluationChunk 0 of generation 0" in str(caught.value)
    assert "within 1 s (compute.compile_timeout_s)" in str(caught.value)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_first_chunk_that_computes_for_too_long_is_said_to_compute(run, engine):
    with pytest.raises(EvaluationError) as caught:
        run(engine, compute_s=60.0, first_chunk_timeout_s=1.0, chunk_timeout_s=0.5, max_attempts=1)
    assert "no answer to work item EvaluationChunk 0 of generation 0" in str(caught.value)
    assert "within 1 s of computing (compute.first_chunk_timeout_s)" in str(caught.value)


@pytest.mark.long
def test_a_first_chunk_may_take_longer_than_later_ones(tmp_path, run):
    """The gradient of a run has no step, and so nothing to wait for."""
    found = run("inline", compute_s=6.0, first_chunk_timeout_s=60.0, chunk_timeout_s=5.0)
    assert found.history["lost_workers"].sum() == 0
    assert check_dispatch(tmp_path / "run")["generations"] == 3
