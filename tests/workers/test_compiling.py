"""Compiling as a step of its own: it computes no episode, leaves nothing to compile, and changes no bit."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from es_service.loop.contents import policy_work
from es_service.protocol.messages import EvaluationChunk, GradientChunk, TrainingChunk, Work, with_subject
from tests.helpers import centre, random_parameters, spec
from tests.workers.test_worker import bits
from workers.simd.episodes import kernel, rollout
from workers.simd.episodes.compiled import EpisodeKernel
from workers.simd.graph.graph import UnsupportedError
from workers.worker import make_worker

POINT = centre(random_parameters(1))
STATISTICS = (np.zeros((20, 2), np.float32), np.ones((20, 2), np.float32))
POLICIES = np.stack([random_parameters(seed) for seed in range(20)])
ITEMS: dict[str, list[Work]] = {
    "training": with_subject(POINT, [TrainingChunk(1, chunk) for chunk in range(2)]),
    "evaluation": with_subject(POINT, [EvaluationChunk(1, chunk) for chunk in range(2)]),
    "gradient": with_subject(POINT, [GradientChunk(1, chunk, np.ones(8, np.float32)) for chunk in range(2)]),
    "policies": policy_work(POLICIES, STATISTICS, 1, traces=True, seed=5, generation=9).work,
}
"""The last chunk of policies has fewer slots."""


@pytest.fixture
def compiled(monkeypatch):
    """What is compiled: "jax" for a function by JAX, "simd" for a kernel."""
    found = []

    def note(name, seconds, **_):
        if "backend_compile" in name:
            found.append("jax")

    def compile_episodes(*arguments, **options):
        found.append("simd")
        return before(*arguments, **options)

    before = rollout.compile_episodes
    monkeypatch.setattr(rollout, "compile_episodes", compile_episodes)
    jax.monitoring.register_event_duration_secs_listener(note)
    yield found
    jax.monitoring.unregister_event_duration_listener(note)


@pytest.mark.parametrize("kind", ITEMS)
@pytest.mark.parametrize("how", ["xla", "simd", "simd, resets by JAX"])
def test_compiling_ahead_leaves_nothing_to_compile_and_changes_no_bit(how, kind, compiled, monkeypatch):
    if "resets" in how:
        monkeypatch.setattr(kernel, "compile_kernel", _unsupported)
    worker_spec, item = spec(rollout=how.partition(",")[0], episode_steps=7), ITEMS[kind]
    expected = list(map(bits, make_worker(worker_spec).run(item)))
    worker = make_worker(worker_spec)
    compiled.clear()
    worker.compile(item)
    once = ["jax"] if how == "xla" else [] if kind == "gradient" else ["simd"] + ["jax"] * ("resets" in how)
    assert compiled == once
    worker.compile(item)
    assert list(map(bits, worker.run(item))) == expected
    assert list(map(bits, worker.run(item))) == expected
    assert compiled == once, "something was compiled again, or at the first call"


def _unsupported(*_, **__):
    raise UnsupportedError("a reset")


def test_compiling_runs_no_episode_and_an_exception_names_what_it_was_for(monkeypatch):
    def run(*_):
        raise AssertionError("an episode")

    monkeypatch.setattr(EpisodeKernel, "run", run)
    worker = make_worker(spec(rollout="simd", episode_steps=7))
    for item in ITEMS.values():
        worker.compile(item)
    monkeypatch.setattr(rollout, "compile_episodes", _unsupported)
    with pytest.raises(UnsupportedError) as raised:
        make_worker(spec(rollout="simd", episode_steps=7)).compile(ITEMS["training"])
    assert raised.value.__notes__ == ["raised in TrainingChunk 0 of generation 1"]
