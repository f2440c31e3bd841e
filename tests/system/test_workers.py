"""Placement cannot change the answer: any number, order, loss or retry of workers gives the same bits."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from es_service import api
from es_service.dispatch import inline_engine
from es_service.dispatch.engine import Engine
from es_service.errors import EvaluationError
from es_service.protocol.messages import TrainingChunk
from es_service.protocol.process_environment import child_environment
from es_service.store.digest import digest_parts
from tests.system.processes import children, committed, is_running, running, wait_for, wait_until

CONFIG = {
    "task": {"environment": "point_maze"},
    "search": {"algorithm": "nsra_es", "pairs": 1024, "evaluation_episodes": 20, "fitness_weight_patience": 2},
    "budget": {"generations": 12},
    "compute": {"engine": "inline", "workers": 2, "chunk_pairs": 32, "gradient_block_pairs": 128},
}
"""Some forty milliseconds a generation: time enough to hit one in the middle."""


def run(folder: Path, on_generation=lambda row: None, on_notice=pytest.fail, **compute):
    config = api.load_config(CONFIG | {"compute": CONFIG["compute"] | compute})
    return api.run(config, folder, on_generation=on_generation, on_notice=on_notice)


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reference") / "run"
    run(folder, workers=1)
    return digest_parts(folder)


@pytest.mark.parametrize(
    ("workers", "kind"),
    [
        (2, "threads"),
        (3, "processes"),
        pytest.param(2, "processes", marks=pytest.mark.long),
        pytest.param(3, "threads", marks=pytest.mark.long),
    ],
)
def test_number_and_kind_of_workers(tmp_path, reference, workers, kind):
    seen = []
    run(tmp_path / "run", lambda row: seen.append(len(children())), workers=workers, inline_workers=kind)
    assert digest_parts(tmp_path / "run") == reference
    assert set(seen) == {workers if kind == "processes" else 1}


def test_bits_of_xla_are_others_and_as_independent_of_workers(tmp_path, reference):
    for workers in (1, 2):
        run(tmp_path / str(workers), rollout="xla", workers=workers)
    assert digest_parts(tmp_path / "1") == digest_parts(tmp_path / "2") != reference


@pytest.mark.alone
def test_a_child_that_is_killed_takes_its_threads_with_it_and_changes_nothing(tmp_path, reference):
    notices = []

    def strike(row):
        if row["generation"] == 4:
            threading.Timer(0.01, os.kill, (children()[-1], signal.SIGKILL)).start()

    outcome = run(tmp_path / "run", strike, notices.append, inline_workers="threads")
    assert [notice.partition(";")[0] for notice in notices] == ["generation 5: lost 2 workers"]
    assert outcome.run.history["retries"].sum() >= 2
    assert digest_parts(tmp_path / "run") == reference
    assert children() == []


@pytest.mark.alone
@pytest.mark.parametrize(
    ("number", "after", "chunk_timeout_s"), [(signal.SIGKILL, (4, 8), 30.0), (signal.SIGSTOP, (4,), 1.0)]
)
def test_a_worker_killed_or_stopped_in_mid_generation(tmp_path, reference, number, after, chunk_timeout_s):
    """Only the deadline tells that workers were stopped; all are, or the others would do without the one."""
    hit, notices = [], []

    def strike(row):
        if row["generation"] in after:  # the next generation has begun when the timer fires
            victims = children()[-1:] if number == signal.SIGKILL else children()
            hit.extend(victims)
            timer = threading.Timer(0.01, lambda: [os.kill(victim, number) for victim in victims])
            timer.start()

    outcome = run(tmp_path / "run", strike, notices.append, chunk_timeout_s=chunk_timeout_s)
    history = outcome.run.history
    what = "a worker" if number == signal.SIGKILL else "2 workers"
    told = [notice.partition(";")[0] for notice in notices]
    assert len(told) == len(after)
    for line, g in zip(told, after, strict=True):  # on a busy machine, it is noticed in the generation after
        assert line in (f"generation {g + 1}: lost {what}", f"generation {g + 2}: lost {what}")
    assert history["lost_workers"].sum() == len(hit)
    assert digest_parts(tmp_path / "run") == reference
    assert children() == []


def test_a_run_goes_on_without_a_worker_that_hangs(tmp_path, reference):
    """The other one computes what it has, long before the deadline."""
    stopped, begun = [], time.monotonic()

    def strike(row):
        if row["generation"] == 4:
            stopped.append(children()[-1])
            os.kill(stopped[0], signal.SIGSTOP)

    outcome = run(tmp_path / "run", strike, chunk_timeout_s=400.0)
    assert time.monotonic() - begun < 300.0
    assert stopped
    assert outcome.run.history[["lost_workers", "retries"]].sum().sum() == 0
    assert digest_parts(tmp_path / "run") == reference
    assert children() == []


@pytest.mark.parametrize("rollout", ["simd", pytest.param("xla", marks=pytest.mark.long)])
def test_run_from_a_process_that_already_used_jax(tmp_path, reference, rollout):
    """The caller's JAX has other threads, 64-bit types and flags; rollouts never see them."""
    expected = reference
    if rollout == "xla":
        run(tmp_path / "xla", rollout="xla")
        expected = digest_parts(tmp_path / "xla")
    config = CONFIG | {"compute": CONFIG["compute"] | {"rollout": rollout}}
    script = f"""
import os
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=true --xla_backend_optimization_level=0"
os.environ["JAX_DISABLE_JIT"] = "1"
import jax
jax.config.update("jax_enable_x64", True)
assert (jax.numpy.ones(5) @ jax.numpy.ones(5)) == 5
from es_service import load_config, run
run(load_config({config!r}), {str(tmp_path / "run")!r})
"""
    ours = ("PJRT_NPROC", "JAX_PLATFORMS", "JAX_COMPILATION_CACHE_DIR")
    environment = {k: v for k, v in os.environ.items() if k not in ours}
    subprocess.run([sys.executable, "-c", script], check=True, cwd=tmp_path, env=environment, timeout=120)
    assert digest_parts(tmp_path / "run") == expected


def test_a_chunk_that_fails_everywhere_ends_the_run_with_its_error(tmp_path, monkeypatch):
    """A poison chunk: the message begins with the worker's own traceback and names it; what is committed stays."""
    begin = Engine.begin

    def poisoned(self, work):
        if work[0][0].generation == 3 and isinstance(work[0][1], TrainingChunk):
            poison = TrainingChunk(3, "two")
            work = [(centre, poison if chunk.chunk_id == 2 else chunk) for centre, chunk in work]
        return begin(self, work)

    monkeypatch.setattr(Engine, "begin", poisoned)
    with pytest.raises(
        EvaluationError, match=r"(?s)ufunc.*in TrainingChunk two of.*TrainingChunk .*3 failed in 4 attempts"
    ):
        run(tmp_path / "run")
    assert api.open_run(tmp_path / "run").generation == 2
    assert children() == []


def test_workers_that_cannot_start_end_the_run_with_their_last_words(tmp_path, monkeypatch):
    broken = child_environment() | {"JAX_PLATFORMS": "no_such_platform"}
    monkeypatch.setattr(inline_engine, "child_environment", lambda gpus, place: broken)
    with pytest.raises(EvaluationError, match="no_such_platform"):
        run(tmp_path / "run", rollout="xla")  # simd needs none
    assert children() == []


def test_a_killed_driver_leaves_no_workers(tmp_path):
    script = f"""
from es_service import load_config, run
run(load_config({CONFIG | {"budget": {"generations": 100_000}}!r}), {str(tmp_path / "run")!r})
"""
    with running(sys.executable, "-c", script) as process:
        wait_until(process, lambda: committed(tmp_path / "run") is not None)
        workers = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        assert len(workers) == 4, "two, and their guards"
        assert all(map(is_running, workers))
    wait_for(lambda: not any(map(is_running, workers)), timeout_s=60.0)
