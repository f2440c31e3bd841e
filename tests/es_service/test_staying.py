"""Workers that stay between the runs of a program: the same bits from fewer processes, and none when it is over."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import es_service
from es_service.dispatch import inline_engine as inline_module
from es_service.dispatch.staying import IDLE_PER_CORE, Staying, staying, workers
from es_service.protocol.child import Child
from es_service.protocol.machine import cores
from es_service.protocol.process_environment import child_environment
from tests.helpers import workers_in_this_process
from tests.system.processes import is_running
from tests.system.session import SMALL
from tests.workers.functions import hill

FUNCTION = {
    "task": {"environment": "function:tests.workers.functions:hill"},
    "search": {"algorithm": "es", "pairs": 4},
    "map": {"enabled": False},
    "budget": {"generations": 2},
    "compute": {"engine": "inline", "workers": 1},
}
"""A run whose worker starts soon, since it loads no JAX."""


def function(**sections):
    return {name: section | sections.get(name, {}) for name, section in FUNCTION.items()} | {
        name: section for name, section in sections.items() if name not in FUNCTION
    }


@pytest.fixture
def started(monkeypatch):
    """The processes of workers that a test has started; all of them have ended after it."""
    started: list[Child] = []

    def start(*given):
        started.append(Child(*given))
        return started[-1]

    monkeypatch.setattr(inline_module, "Child", start)
    yield started
    assert not staying()._idle
    assert not any(is_running(child.pid) for child in started)


def run(config, folder: Path, **given):
    return es_service.run(config, folder, on_notice=pytest.fail, **given).run


@pytest.mark.slow
def test_runs_and_evaluators_share_a_process_and_have_the_bits_that_they_have_alone(tmp_path, started):
    fine = function(search={"sigma": 0.01}, seed=7)
    alone = [run(config, tmp_path / f"alone_{seed}").digest() for seed, config in enumerate((FUNCTION, fine))]
    assert len(started) == 2
    points = np.random.default_rng(0).normal(size=(5, 3))
    with workers():
        again = [run(config, tmp_path / f"stays_{seed}") for seed, config in enumerate((FUNCTION, fine))]
        with es_service.evaluator(FUNCTION) as evaluate:
            values = evaluate(points).fitness[:, 0]
        with es_service.evaluator(FUNCTION) as evaluate:
            assert np.array_equal(evaluate(points).fitness[:, 0], values)
        assert [one.digest() for one in again] == alone
        assert len(started) == 3
    width, height, rest = points[0] * [2.0, 0.5, 1.0] + [3.0, 0.5, 0.0]
    assert values[0] == pytest.approx(hill([width, height, rest])[0], rel=1e-5)


@pytest.mark.slow
def test_what_was_compiled_serves_another_seed_and_the_process_another_task_and_policy(tmp_path, started):
    configs = [SMALL | {"budget": {"generations": 2}} | more for more in (
        {}, {"seed": 5}, {"policy": {"hidden": [4]}}, {"task": {"environment": "point_maze", "episode_steps": 20}}, {}
    )]  # fmt: skip
    with workers_in_this_process():
        alone = [run(config, tmp_path / f"alone_{number}").digest() for number, config in enumerate(configs)]
    compiled: list[float] = []

    def note(entry):
        if isinstance(entry, inline_module.Compiled):
            compiled.append(entry.seconds)

    with pytest.MonkeyPatch.context() as patch, workers():
        patch.setattr("es_service.runs.engine.noting", lambda log, spec: note)
        runs = [run(config, tmp_path / f"stays_{number}") for number, config in enumerate(configs)]
    assert [one.digest() for one in runs] == alone
    assert len(started) == 1
    kinds = len(compiled) // len(configs)
    first, seed, policy, task, again = (compiled[at : at + kinds] for at in range(0, len(compiled), kinds))
    assert min(map(max, (first, policy, task))) > 0.0 == max(*seed, *again), (
        "kept with the constants, whatever the seed"
    )


@pytest.mark.slow
def test_a_function_with_other_settings_has_a_process_of_its_own(tmp_path, started):
    with workers():
        run(FUNCTION, tmp_path / "one")
        run(function(task={"episodes_per_member": 2}), tmp_path / "other")
        run(FUNCTION, tmp_path / "again")
    assert len(started) == 2


@pytest.mark.slow
def test_another_environment_or_folder_is_that_of_new_processes(tmp_path, started, monkeypatch):
    with workers():
        run(FUNCTION, tmp_path / "one")
        monkeypatch.setenv("SIMULATOR_LICENCE", "7")
        run(FUNCTION, tmp_path / "other")
        monkeypatch.chdir(tmp_path)
        run(FUNCTION, tmp_path / "elsewhere")
    assert len(started) == 3


@pytest.mark.slow
def test_a_process_that_was_killed_while_it_waited_is_replaced_without_a_word(tmp_path, started):
    with workers():
        digest = run(FUNCTION, tmp_path / "one").digest()
        os.kill(started[0].pid, signal.SIGKILL)
        os.waitid(os.P_PID, started[0].pid, os.WEXITED | os.WNOWAIT)
        again = run(FUNCTION, tmp_path / "again")
        assert (again.digest(), again.history["lost_workers"].sum()) == (digest, 0)
    assert len(started) == 2


def test_what_computes_when_a_run_ends_does_not_stay(tmp_path, started):
    """By Ctrl-C in the middle of a run, and by an error of the caller's."""

    class EndedError(Exception):
        pass

    def end(row):
        raise EndedError

    def interrupt(row):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), workers():
        run(FUNCTION, tmp_path / "one", on_generation=interrupt)
    with workers():
        with pytest.raises(EndedError):
            run(function(budget={"generations": 50}), tmp_path / "two", on_generation=end)
        assert len(staying()._idle) == sum(is_running(child.pid) for child in started) <= 1
        run(FUNCTION, tmp_path / "three")


@pytest.mark.slow
def test_seconds_of_processors_are_those_for_a_run_also_while_the_processes_of_others_wait(tmp_path, started):
    with workers():
        with es_service.evaluator(FUNCTION) as evaluate:
            transport = evaluate._engine.transport
            before_s = transport.cpu_s() - time.process_time() - started[0].cpu_s
            run(FUNCTION, tmp_path / "one")
            run(FUNCTION, tmp_path / "two")
            run(FUNCTION | {"seed": 3}, tmp_path / "three")
            _, other = started
            assert other.is_running
            assert other.cpu_s > 0.02, "it has started Python"
            used_s = transport.cpu_s() - time.process_time() - started[0].cpu_s
            assert used_s == pytest.approx(before_s, abs=other.cpu_s / 2), "without the other's"
        begun_s, driver_s = other.cpu_s + started[0].cpu_s, time.process_time()
        again = run(FUNCTION, tmp_path / "four")
        used_s = time.process_time() - driver_s + other.cpu_s + started[0].cpu_s - begun_s
        assert again.history["cpu_s"].iloc[-1] <= used_s + 0.05
    assert len(started) == 2


def test_a_process_that_has_ended_says_how_long_it_computed():
    child = Child("tests.es_service.shell_child:shell", child_environment())
    busy = "i=0; while [ $i -lt 400000 ]; do i=$((i+1)); done"
    child.call("shell")
    started_s = child.cpu_s
    child.call(busy)
    before_s = child.cpu_s
    assert before_s > started_s + 0.05, "with what it has started"
    assert child.end().cpu_s == child.cpu_s == pytest.approx(before_s, abs=0.1)


def test_blocks_can_be_nested_and_overlap_in_threads(tmp_path, started):
    digests = {}

    def runs(number):
        with workers():
            for again in range(2):
                digests[number, again] = run(FUNCTION, tmp_path / f"{number}_{again}").digest()

    threads = [threading.Thread(target=runs, args=(number,)) for number in range(2)]
    with workers():
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert is_running(started[0].pid), "until the outer block ends"
        with workers():
            run(FUNCTION, tmp_path / "inner")
    assert len(set(digests.values())) == 1
    assert len(digests) == 4
    assert 1 <= len(started) <= 2


def test_the_newest_wait_and_those_that_have_waited_longest_end():
    most = IDLE_PER_CORE * cores()
    some = Staying()
    some.enter()
    children = [Child("tests.es_service.shell_child:shell", child_environment()) for _ in range(most + 1)]
    for number, child in enumerate(children):
        some.give(number % 2, child)
    assert [child.is_ended for child in children] == [True] + [False] * most
    assert some.take(most % 2) is children[most]
    some.leave()
    assert [child.is_running for child in children] == [False] * most + [True]
    some.give(0, children[most])
    assert children[most].is_ended, "outside of a block"
