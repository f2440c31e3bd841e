"""Ray on this machine: the same bits as inline, through lost and hanging workers; the caller's settings stay."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest

import es_service
from es_service import api
from es_service.cli.common import error_message
from es_service.dispatch import ray_cluster as module
from es_service.dispatch.events import Limits
from es_service.dispatch.ray_engine import Actors, ray_engine
from es_service.dispatch.staying import staying
from es_service.errors import EvaluationError, StartError
from es_service.store.digest import digest_parts
from es_service.store.reader import read_generation
from tests.dispatch_checker import check_dispatch
from tests.helpers import spec, workers_in_this_process
from tests.system.processes import ROOT, running, wait_until, without_copies
from tests.system.session import SMALL
from workers.actor import WorkerActor

pytestmark = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),  # Ray leaves files and processes to the garbage collector
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
CONFIG = SMALL | {"compute": {"engine": "ray", "chunk_pairs": 4, "gradient_block_pairs": 8, "dispatch_log": True}}


def sessions() -> set[Path]:
    """Folders that Ray has made for sessions of this process and that are still there."""
    return set(Path("/tmp/ray").glob(f"session_*_{os.getpid()}"))


def run(folder: Path, on_notice=pytest.fail, **compute):
    config = api.load_config(CONFIG | {"compute": CONFIG["compute"] | compute})
    return api.run(config, folder, on_notice=on_notice)


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reference") / "run"
    with workers_in_this_process():
        run(folder, engine="inline", workers=1)
    return digest_parts(folder)


@pytest.mark.alone
def test_the_same_bits_as_inline_and_nothing_of_the_caller_s_changed(tmp_path, reference, monkeypatch):
    """A leftover RAY_ADDRESS captures nothing, settings of JAX reach no worker, handlers and environment stay; nothing
    of Ray's is left in /tmp, nor a link to it, which would keep Ray from making another."""
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    monkeypatch.setenv("PJRT_NPROC", "2")
    monkeypatch.setenv("JAX_ENABLE_X64", "1")
    handlers, environment = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)], dict(os.environ)
    before = sessions()
    run(tmp_path / "run", workers=1)
    assert digest_parts(tmp_path / "run") == reference
    assert sessions() == before
    latest = Path("/tmp/ray/session_latest")
    assert latest.exists() or not latest.is_symlink()
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == handlers
    assert dict(os.environ) == environment


@pytest.mark.alone
@pytest.mark.long
def test_an_actor_stays_in_a_block_until_it_is_killed_or_hangs_or_the_user_ends_ray(tmp_path, reference):
    import ray

    before, places = sessions(), []

    def again(name):
        outcome = run(tmp_path / name, workers=1)
        assert digest_parts(outcome.run.folder) == reference
        assert outcome.run.history["lost_workers"].sum() == 0
        [(_, connection)] = staying()._idle
        [(_, actor)] = connection._actors
        places.append(ray.get(actor.place.remote()).pid)
        return outcome.run.history["cpu_s"].iloc[-1]

    with es_service.workers():
        new_s, taken_over_s = again("new"), again("taken_over")
        assert taken_over_s < 0.7 * new_s, "without the import of JAX, and without the run before"
        os.kill(places[-1], signal.SIGKILL)
        again("after_a_kill")
        os.kill(places[-1], signal.SIGSTOP)
        again("after_a_stop")
        ray.shutdown()
        again("after_the_end")
    assert places[0] == places[1]
    assert len(set(places)) == 4
    assert not ray.is_initialized()
    assert len(sessions() - before) <= 1, "the logs of the Ray that the user has ended"


@pytest.mark.alone
def test_lost_and_hanging_workers_change_nothing(tmp_path, reference, monkeypatch):
    """One of two workers is killed in mid-generation, then one is stopped, which only our own deadline notices if the
    other worker gets no copies. Their last words stay in Ray's logs."""
    faults, send = {4: signal.SIGKILL, 12: signal.SIGSTOP}, Actors.send

    def send_and_strike(self, worker, key, attempt, work):
        number = faults.pop(key.generation, None) if key.kind == "TrainingChunk" else None
        if number is not None:
            os.kill(self.places()[worker].pid, signal.SIGSTOP)  # or it might have answered before it is struck
        send(self, worker, key, attempt, work)
        if number is not None:
            os.kill(self.places()[worker].pid, number)

    monkeypatch.setattr(Actors, "send", send_and_strike)
    without_copies(monkeypatch)
    notices, before = [], sessions()
    outcome = run(tmp_path / "run", on_notice=notices.append, workers=2, chunk_timeout_s=1.0)
    assert digest_parts(tmp_path / "run") == reference
    assert not faults
    assert len(sessions() - before) == 1
    assert outcome.run.history["lost_workers"].sum() == 2
    assert [notice.partition(" lost ")[0] for notice in notices] == ["generation 4:", "generation 12:"]
    assert "its process or its node died" in notices[0]
    assert "no answer to work item TrainingChunk" in notices[1]
    counts = check_dispatch(tmp_path / "run")
    assert (counts["sessions"], counts["generations"]) == (1, 31)
    assert counts["repeated"] == outcome.run.history["retries"].sum() >= 2


@pytest.mark.alone
@pytest.mark.parametrize("cores", [pytest.param(1, marks=pytest.mark.long), 2])
def test_a_run_goes_on_without_an_actor_that_hangs(tmp_path, reference, monkeypatch, cores):
    """The other one computes what it has, long before the deadline; a copy is no retry."""
    stopped, send, begun = [], Actors.send, time.monotonic()

    def send_and_stop(self, worker, key, attempt, work):
        send(self, worker, key, attempt, work)
        if not stopped and key.generation == 4:
            stopped.append(worker)
            os.kill(self.places()[worker].pid, signal.SIGSTOP)

    monkeypatch.setattr(Actors, "send", send_and_stop)
    resources = {"workers": 2 * cores, "worker_resources": {"cpu": cores}}
    outcome = run(tmp_path / "run", chunk_timeout_s=400.0, **resources)
    assert time.monotonic() - begun < 300.0
    assert digest_parts(tmp_path / "run") == reference
    assert outcome.run.history[["lost_workers", "retries"]].sum().sum() == 0
    counts = check_dispatch(tmp_path / "run")
    assert (counts["repeated"], counts["lost"]) == (0, 0)
    assert counts["copied"] > 0


def test_a_run_that_began_inline_goes_on_with_ray_where_home_cannot_be_written(tmp_path, reference):
    """As a user would, from the shell; SIGTERM stops it with its own exit code, although Ray has a handler too."""
    program = [sys.executable, "-m", "es_service"]
    home = {**os.environ, "HOME": "/proc/nowhere", "PYTHONPATH": str(ROOT)}
    config = api.load_config(
        CONFIG | {"budget": {"generations": 7}, "compute": CONFIG["compute"] | {"engine": "inline"}}
    )
    api.run(config, tmp_path / "run")
    long = ["--engine", "ray", "--workers", "1", "--set", "budget.generations=1000000"]
    with running(*program, "resume", tmp_path / "run", *long, env=home) as driver:
        wait_until(driver, lambda: (read_generation(tmp_path / "run") or 0) > 7, timeout_s=120)
        driver.terminate()
        _, errors = driver.communicate(timeout=60)
    assert driver.returncode == 143, errors
    reached = read_generation(tmp_path / "run")
    inline = api.load_config(
        CONFIG | {"budget": {"generations": reached}, "compute": CONFIG["compute"] | {"engine": "inline"}}
    )
    with workers_in_this_process():
        api.run(inline, tmp_path / "straight")
    assert digest_parts(tmp_path / "run") == digest_parts(tmp_path / "straight")


@pytest.mark.alone
def test_a_cluster_without_room_is_named_with_what_it_has(monkeypatch):
    connect = module.connect
    monkeypatch.setattr(module, "connect", lambda address, *, gpus, cpus: connect(address, gpus=gpus, cpus=0))
    start = time.monotonic()
    with pytest.raises(
        EvaluationError, match=r"this machine has no room for a worker\. Each worker needs 1 CPU; .*has 0 CPU, 0 GPU"
    ):
        ray_engine(spec(), Limits(1), actor=WorkerActor)
    assert time.monotonic() - start < 30


def test_a_wrong_address_is_named_with_the_way_out():
    with pytest.raises(EvaluationError, match=r"could not connect to a Ray cluster at 127\.0\.0\.1:1") as error:
        ray_engine(spec(), Limits(1), actor=WorkerActor, address="127.0.0.1:1")
    assert error_message(error.value).endswith(" resume RUN --engine inline --set compute.workers=auto")


def test_a_run_that_cannot_begin_leaves_no_folder_behind(tmp_path):
    """But a folder that was there, a run that is resumed and the parent of a fork are kept."""
    nobody = {"engine": "ray", "address": "127.0.0.1:1"}
    new, mine, old = tmp_path / "new", tmp_path / "mine", tmp_path / "old"
    mine.mkdir()
    for folder in (new, mine):
        with pytest.raises(StartError, match="nothing listens at that address") as error:
            run(folder, **nobody)
        inline = f"run CONFIG --out {folder} --engine inline --set compute.workers=auto"
        assert error_message(error.value).endswith(f"to work on this machine without Ray: es-service {inline}")
    assert os.listdir(tmp_path) == ["mine"]
    assert os.listdir(mine) == []
    run(old, engine="inline", workers=1)
    before, cluster = digest_parts(old), ["compute.engine=ray", "compute.address=127.0.0.1:1"]
    more = "budget.generations=40"
    with pytest.raises(StartError) as error:
        api.fork(old, [*cluster, more], out=new, generation=29)
    assert error_message(error.value).endswith(
        f" fork {old} --generation 29 --out {new} --engine inline --set {more} --set compute.workers=auto"
    )
    assert not new.exists()
    with pytest.raises(StartError) as error:
        api.resume(old, [*cluster, more])
    assert f" resume {old} --engine inline" in error_message(error.value)
    assert digest_parts(old) == before


def test_without_ray_the_error_says_what_does_without(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(EvaluationError, match=r"Ray cannot be imported ") as error:
        ray_engine(spec(), Limits(1), actor=WorkerActor)
    assert error_message(error.value).endswith(" resume RUN --engine inline --set compute.workers=auto")


@pytest.mark.long
def test_it_works_in_a_thread_where_signals_cannot_be_set(tmp_path, reference):
    thread = threading.Thread(target=run, args=(tmp_path / "run",), kwargs={"workers": 2})
    thread.start()
    thread.join()
    assert digest_parts(tmp_path / "run") == reference


def test_a_gpu_that_is_not_there_is_named():
    with pytest.raises(EvaluationError, match=r"needs 1 CPU and 1 GPU; the cluster has 1 CPU, 0 GPU in total"):
        ray_engine(spec(), Limits(1), actor=WorkerActor, gpus=1.0)


def test_what_an_actor_has_printed_before_it_ended_its_process_is_in_the_error(tmp_path):
    config = {
        "task": {"environment": "python:tests.workers.host_tasks:Deadly"},
        "search": {"algorithm": "es", "pairs": 2, "evaluation_episodes": 2},
        "map": {"enabled": False},
        "budget": {"generations": 2},
        "compute": {"engine": "ray", "workers": 1, "max_attempts": 1},
    }
    with pytest.raises(EvaluationError) as caught:
        api.run(config, tmp_path / "run")
    text = str(caught.value)
    assert "its process or its node died" in text
    assert "the last output of its process:\n" in text
    assert "the licence has expired" in text.partition("the last output of its process:\n")[2]
