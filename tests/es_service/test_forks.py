"""What was made before os.fork() is refused in the new process, and goes on in the old one as if nothing happened."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from es_service import api
from tests.system.processes import ROOT
from tests.system.session import SMALL

BEGIN = """
import contextlib, os, sys
import numpy as np
from es_service import ask_tell, evaluator, run
from es_service.errors import ForkedError
from tests.system.session import SMALL

def in_fork(use):
    sys.stdout.flush()
    if os.fork() == 0:
        try:
            use()
            print("worked", flush=True)
        except ForkedError as error:
            print("refused:", error, flush=True)
        finally:
            os._exit(0)
    os.wait()

def same(first, second):
    print("same", all(map(np.array_equal, first, second)))
"""
EVALUATOR = """
with evaluator(SMALL) as evaluate:
    policies = np.stack([evaluate.initial()] * 3)
    def use():
        with contextlib.closing(evaluate):
            evaluate(policies)
    before = evaluate(policies).fitness
    in_fork(use)
    same([before], [evaluate(policies).fitness])
"""
ASK_TELL = """
config = {"task": {"environment": "caller", "options": {"parameters": 3}},
          "search": {"algorithm": "es", "pairs": 4, "evaluation_episodes": 1}, "map": {"enabled": False},
          "budget": {"generations": 2}}
def use():
    try:
        search.tell(asked, asked.parameters[:, 0])
    except ForkedError:
        asking.__exit__(*sys.exc_info())
        raise
asking = ask_tell(config, sys.argv[1])
search = asking.__enter__()
while (asked := search.ask()) is not None:
    if asked.generation == 1 and asked.trains.any():
        in_fork(use)
    search.tell(asked, asked.parameters[:, 0])
asking.__exit__(None, None, None)
same([search.run.generation], [2])
"""
ENVIRONMENTS = """
from es_service.environments.vector import TaskVectorEnv
envs, others = (TaskVectorEnv("point_maze", 512, threads=2) for _ in range(2))
actions = np.zeros(envs.action_space.shape, np.float32)
for one in (envs, others):
    one.reset(seed=0)
def use():
    with contextlib.closing(envs):
        envs.step(actions)
in_fork(use)
same(envs.step(actions)[:3], others.step(actions)[:3])
"""
CHILD = """
from workers.host.functions import Caller
call = Caller("function:tests.examples.beam:beam", {}, 60.0)
design = np.full(len(call.task.parameters.names), 0.5, np.float32)
before = call(design, 0)
def use():
    with contextlib.closing(call):
        call(design, 0)
in_fork(use)
same(before[1], call(design, 0)[1])
call.close()
"""
STORE = """
from pathlib import Path
from es_service.store.lock import lock_holder
from es_service.store.writer import RunStore
folder = Path(sys.argv[1])
run(SMALL | {"budget": {"generations": 1}}, folder)
store = RunStore.open(folder)
def use():
    with store:
        store.record_platform(2, {"cpu": "another"})
in_fork(use)
same([lock_holder(folder)["pid"], store.record_platform(2, {"cpu": "another"})], [os.getpid(), True])
store.close()
"""
SWEEP = """
from es_service import sweep
from pathlib import Path
from es_service.store.lock import lock_holder
is_forked, holders = None, []
def forks(runs):
    global is_forked
    if is_forked is None:
        sys.stdout.flush()
        is_forked = os.fork() == 0
        if not is_forked:
            os.wait()
            holders.append(lock_holder(Path(sys.argv[1], ".sweep"))["pid"])
try:
    given = SMALL | {"budget": {"generations": 1}}
    same([run.state for run in sweep(given, sys.argv[1], seeds=[0], on_progress=forks)], ["finished"])
    same(holders, [os.getpid()])
except ForkedError as error:
    print("refused:", error, flush=True)
    os._exit(0)
"""
RUN = """
def forks(row):
    global is_forked
    if row["generation"] == 2:
        sys.stdout.flush()
        is_forked = os.fork() == 0
        if not is_forked:
            os.wait()
is_forked = False
try:
    done = run(SMALL | {"budget": {"generations": 5}}, sys.argv[1], on_generation=forks).run
    print("worked" if is_forked else done.digest(), flush=True)
except ForkedError as error:
    print("refused:", error, flush=True)
    os._exit(0)
"""


def printed(program: str, *arguments: object) -> list[str]:
    """Lines that a program prints; JAX warns of every fork."""
    words = [sys.executable, "-W", "ignore", "-c", BEGIN + program, *map(str, arguments)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.parametrize(
    ("program", "what"),
    [
        (EVALUATOR, "this evaluator"),
        (ASK_TELL, "this ask_tell"),
        (ENVIRONMENTS, "a vector environment with threads"),
        (CHILD, "the child process of a task"),
        (STORE, "the writer of "),
        (SWEEP, "a sweep"),
    ],
    ids=["evaluator", "ask_tell", "threads", "child", "store", "sweep"],
)
@pytest.mark.slow
def test_a_forked_process_is_refused_and_the_other_goes_on(program, what, tmp_path):
    refusal, *same = printed(program, tmp_path / "run")
    assert refusal.startswith(f"refused: {what}")
    assert " belongs to process " in refusal
    assert "which os.fork() or multiprocessing has made of it; " in refusal
    assert set(same) == {"same True"}


@pytest.mark.slow
def test_a_run_goes_on_in_the_process_that_began_it_alone(tmp_path, one_process):
    refusal, digest = printed(RUN, tmp_path / "run")
    assert refusal.startswith("refused: the session of a run belongs to process ")
    whole = api.run(SMALL | {"budget": {"generations": 5}}, tmp_path / "whole")
    assert digest == whole.run.digest()
    assert os.listdir(tmp_path / "run").count("run.db-wal") == 0
