"""Ray on this machine: the same bits as inline, through lost and hanging workers; the caller's settings stay."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from es_service import api
from es_service.digest import digest_parts
from es_service.dispatch import ray_engine as module
from es_service.dispatch.messages import Policy
from es_service.dispatch.ray_engine import Actors, ray_engine
from es_service.errors import EvaluationError
from es_service.protocol import TrainingChunk
from tests.helpers import centre, random_parameters, spec
from tests.system.session import ROOT, SMALL
from workers.actor import WorkerActor

pytestmark = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),  # Ray leaves files and processes to the garbage collector
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
CONFIG = SMALL | {"compute": {"chunk_pairs": 4, "chunk_timeout_s": 1.0, "engine": "ray"}}


def run(folder: Path, **compute):
    config = api.load_config(CONFIG | {"compute": CONFIG["compute"] | compute})
    return api.run(config, folder)


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reference") / "run"
    run(folder, engine="inline", workers=1)
    return digest_parts(folder)


def test_the_same_bits_as_inline_and_nothing_of_the_caller_s_changed(tmp_path, reference, monkeypatch):
    """A leftover RAY_ADDRESS captures nothing, settings of JAX reach no worker, handlers and environment stay."""
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    monkeypatch.setenv("PJRT_NPROC", "2")
    monkeypatch.setenv("JAX_ENABLE_X64", "1")
    handlers, environment = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)], dict(os.environ)
    run(tmp_path / "run", workers=1)
    assert digest_parts(tmp_path / "run") == reference
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == handlers
    assert dict(os.environ) == environment


def test_lost_and_hanging_workers_change_nothing(tmp_path, reference, monkeypatch):
    """One of two workers is killed in mid-generation, then one is stopped, which only our own deadline notices."""
    faults = {4: signal.SIGKILL, 12: signal.SIGSTOP}
    send = Actors.send

    def send_and_strike(self, worker, centre, key, attempt, chunk):
        send(self, worker, centre, key, attempt, chunk)
        number = faults.pop(chunk.generation, None) if isinstance(chunk, TrainingChunk) else None
        if number is not None:
            os.kill(int(re.findall(r"pid (\d+)", self.places()[worker])[0]), number)

    monkeypatch.setattr(Actors, "send", send_and_strike)
    outcome = run(tmp_path / "run", workers=2)
    assert digest_parts(tmp_path / "run") == reference
    assert not faults
    assert outcome.run.history["lost_workers"].sum() == 2


def test_a_run_that_began_inline_goes_on_with_ray_where_home_cannot_be_written(tmp_path, reference):
    """As a user would, from the shell; SIGTERM stops it with its own exit code, although Ray has a handler too."""
    program = [sys.executable, "-m", "es_service"]
    home = {**os.environ, "HOME": "/proc/nowhere", "PYTHONPATH": str(ROOT)}
    config = api.load_config(
        CONFIG | {"budget": {"generations": 7}, "compute": CONFIG["compute"] | {"engine": "inline"}}
    )
    api.run(config, tmp_path / "run")
    long = ["--engine", "ray", "--workers", "1", "--set", "budget.generations=1000000"]
    driver = subprocess.Popen(
        [*program, "resume", tmp_path / "run", *long], env=home, stdout=subprocess.PIPE, text=True
    )
    assert driver.stdout is not None
    driver.stdout.readline()
    driver.terminate()
    driver.communicate(timeout=60)
    assert driver.returncode == 143
    reached = api.open_run(tmp_path / "run").generation
    assert reached is not None
    assert reached > 7
    inline = api.load_config(
        CONFIG | {"budget": {"generations": reached}, "compute": CONFIG["compute"] | {"engine": "inline"}}
    )
    api.run(inline, tmp_path / "straight")
    assert digest_parts(tmp_path / "run") == digest_parts(tmp_path / "straight")


def test_workers_that_raise_while_starting_stop_the_run_with_their_error():
    with (
        pytest.raises(EvaluationError, match=r"3 workers in a row did not come up(.|\n)*no_such_task"),
        ray_engine(spec(environment="no_such_task"), Policy(1, restart_backoff_s=0.0), actor=WorkerActor) as engine,
    ):
        engine.evaluate(centre(random_parameters()), [TrainingChunk(1, 0)])


def test_a_chunk_that_raises_everywhere_stops_the_run_with_its_error():
    wrong = random_parameters(size=3)  # parameters of another network
    with (
        pytest.raises(EvaluationError, match=r"TrainingChunk 0 of generation 1 failed in 2 attempts(.|\n)*TypeError"),
        ray_engine(spec(), Policy(1, max_attempts=2), actor=WorkerActor) as engine,
    ):
        engine.evaluate(centre(wrong), [TrainingChunk(1, 0)])


def test_a_cluster_without_room_is_named_with_what_it_has(monkeypatch):
    connect = module._connect
    monkeypatch.setattr(module, "_connect", lambda address, workers: connect(address, 0))
    monkeypatch.setattr(module, "PLACEMENT_S", 2.0)
    start = time.monotonic()
    with (
        pytest.raises(
            EvaluationError, match=r"no worker was given a place in 2 s\. Each needs 1 CPU; .*has 0 CPU, 0 GPU"
        ),
        ray_engine(spec(), Policy(1), actor=WorkerActor) as engine,
    ):
        engine.evaluate(centre(random_parameters()), [TrainingChunk(1, 0)])
    assert time.monotonic() - start < 30


def test_a_wrong_address_is_named_with_the_way_out():
    with pytest.raises(EvaluationError, match=r"no Ray cluster at 127\.0\.0\.1:1 .*--engine inline"):
        ray_engine(spec(), Policy(1), actor=WorkerActor, address="127.0.0.1:1")


def test_without_ray_the_error_says_what_does_without(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(EvaluationError, match=r"Ray cannot be imported .*--engine inline"):
        ray_engine(spec(), Policy(1), actor=WorkerActor)


def test_it_works_in_a_thread_where_signals_cannot_be_set(tmp_path, reference):
    thread = threading.Thread(target=run, args=(tmp_path / "run",), kwargs={"workers": 2})
    thread.start()
    thread.join()
    assert digest_parts(tmp_path / "run") == reference
