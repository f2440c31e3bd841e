"""A worker with several cores: the same results as with one, whichever way its cores are made."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import textwrap
import threading
from collections import Counter
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from es_service.protocol.episodes import in_blocks
from tests.helpers import spec
from tests.system.processes import ROOT, is_running, wait_for
from tests.workers.test_worker import bits, work
from workers import cores as module
from workers.compiling import Compilable
from workers.cores import Cores, parts
from workers.worker import Made, make_worker


@given(st.integers(1, 300), st.integers(1, 64))
def test_parts_are_even_in_order_and_enough_for_each_core(chunks, cores):
    found = parts(range(chunks), cores)
    assert [chunk for part in found for chunk in part] == list(range(chunks))
    sizes = [len(part) for part in found]
    assert max(sizes) - min(sizes) <= 1
    assert len(found) == min(chunks, cores) or len(found) == 2 * cores


def test_threads_with_simd_give_the_results_of_one_core(monkeypatch):
    worker_spec, threads = spec(rollout="simd", episode_steps=30), Counter()
    run = make_worker(worker_spec)

    def watched(part):
        threads[threading.get_ident()] += 1
        return run(part)

    monkeypatch.setattr(module, "compiled_before", lambda *_: Made(Compilable(watched, run.compile), set()))
    found = Cores(3).made(worker_spec).run_chunks(work())
    assert list(map(bits, found)) == list(map(bits, run(work())))
    assert len(threads) == 3
    assert threading.get_ident() not in threads


PROGRAM = """
import os, pickle, sys
from es_service.protocol.episodes import in_blocks
from es_service.protocol.process_environment import worker_environment

if __name__ == "__main__":
    os.environ.update(worker_environment(os.environ))
    from tests.helpers import spec
    from tests.workers.test_worker import work
    from workers.cores import Cores

    cores = Cores(2)
    run = cores.made(spec(rollout="xla", episode_steps=30)).run_chunks
    run.compile(work())  # in each child
    results = run(work())
    if len(sys.argv) > 1:
        print(*(child.pid for child in cores.children), flush=True)
        if sys.argv[1] == "end":
            os.kill(os.getpid(), 9)
        os.kill(cores.children[0].pid, 9)
        run(work())
    sys.stdout.buffer.write(pickle.dumps(results))
"""


TWO_ITEMS = """
import pickle, sys, time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

if __name__ == "__main__":
    import numpy as np
    from es_service.protocol.messages import EvaluationChunk, PolicySpec
    from tests.helpers import centre, spec
    from workers.actor import WorkerActor

    given = spec(environment="function:tests.workers.functions:patient", rollout="host", episode_steps=1,
                 policy=PolicySpec((0, 1), bias=True), chunk_pairs=1)
    actor = WorkerActor(pickle.dumps(given), 0, cores=2)
    actor.build()

    def item(value):
        subject = centre(np.full(1, value), observation_size=0)
        return pickle.dumps(({}, {}, pickle.dumps([(subject, EvaluationChunk(1, 0))])))

    with ThreadPoolExecutor(2) as calls:
        first = calls.submit(actor.run, item(1.0))
        while not Path(sys.argv[1], "begun").exists():
            time.sleep(0.01)
        hangs = actor.progress()
        time.sleep(0.1)
        assert actor.progress() == hangs, "it waits"
        second = calls.submit(actor.run, item(-1.0))
        fitness = [pickle.loads(call.result())[0][0].fitness for call in (first, second)]
    assert actor.progress() != hangs
    assert np.array_equal(fitness, np.full_like(fitness, 1.0) * [[1.0], [-1.0]]), fitness
"""


def test_a_core_that_has_nothing_left_to_do_begins_the_next_work_item(tmp_path, monkeypatch):
    monkeypatch.setenv("PATIENT_FOLDER", str(tmp_path))
    done = child_program(tmp_path, str(tmp_path), program=TWO_ITEMS)
    assert done.returncode == 0, done.stderr.decode()


LOUD = """
import os, pickle, sys, time

if __name__ == "__main__":
    from es_service.protocol.messages import TrainingChunk
    from tests.workers.host_tasks import Loud
    from tests.workers.test_host import MODULE, centre_of, drift
    from dataclasses import replace
    from workers.actor import WorkerActor

    given = replace(drift(), environment=f"python:{MODULE}:Loud", output_bytes=200_000)
    actor = WorkerActor(pickle.dumps(given), 0, cores=int(sys.argv[1]))
    actor.build()
    centre = centre_of(given)
    actor.run(pickle.dumps(({}, {}, pickle.dumps([(centre, TrainingChunk(1, chunk)) for chunk in range(6)]))))
    time.sleep(0.1)
    os.write(1, b"the last line\\n")
    os.kill(os.getpid(), 9)
"""


@pytest.mark.slow
@pytest.mark.parametrize("cores", [1, pytest.param(2, marks=pytest.mark.long)])
def test_an_actor_keeps_the_newest_of_the_files_to_which_ray_has_it_write(tmp_path, cores):
    """Here another program opens them, as Ray does: one for each stream, to append. 12 MB are printed."""
    program, files = tmp_path / "program.py", [tmp_path / "out", tmp_path / "err"]
    program.write_text(LOUD)
    with files[0].open("ab") as out, files[1].open("ab") as err:
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(
            [sys.executable, program, str(cores)], env=environment, stdout=out, stderr=err, timeout=120
        )
    assert done.returncode == -signal.SIGKILL, files[1].read_text()
    text = files[0].read_text()
    assert len(text) <= 100_000
    assert text.endswith("the last line\n")
    lines = text.splitlines()
    assert lines.count("joint limit reached") >= len(lines) - 4, "a line may be torn where the file was cut"
    assert "step 39 is done" in files[1].read_text()


HANDED_OVER = """
import os, pickle, sys, time
from dataclasses import replace

if __name__ == "__main__":
    from tests.helpers import spec
    from tests.workers.test_cores import runs_of_one_actor
    from tests.workers.test_worker import work
    from workers.actor import WorkerActor

    rollout, cores, file = sys.argv[1:]
    given, *others = runs_of_one_actor(rollout)
    actor = WorkerActor(pickle.dumps(given), 0, cores=int(cores))
    item, said = pickle.dumps(({}, {}, pickle.dumps(work()))), []
    for number, other in enumerate((None, *others)):
        actor.build(other and pickle.dumps(other))
        begun_s = time.process_time()
        compile_s = actor.compile(item)
        os.write(1, b"run %d\\n" % number)
        answers = [pickle.loads(actor.run(item)) for _ in range(2)]
        most_s = time.process_time() - begun_s
        said.append((compile_s, answers, most_s, os.pread(1, 1000, 0)))
    with open(file, "wb") as written:
        pickle.dump(said, written)
"""


def runs_of_one_actor(rollout):
    """Constants of the runs that one actor serves, one after another."""
    first = spec(rollout=rollout, episode_steps=30)
    return (
        replace(first, recycle_after_episodes=10**6),
        replace(first, seed=5, recycle_after_episodes=10**6),
        replace(first, episode_steps=20),
        replace(first, recycle_after_episodes=1),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rollout", "cores"), [("simd", 1), ("simd", 2), pytest.param("xla", 2, marks=pytest.mark.long)]
)
def test_an_actor_that_is_taken_over_has_the_bits_of_a_new_one_and_tells_only_of_the_new_run(tmp_path, rollout, cores):
    program, file, out = tmp_path / "program.py", tmp_path / "said", tmp_path / "out"
    program.write_text(HANDED_OVER)
    with out.open("a+b") as printed:
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        words = [sys.executable, program, rollout, str(cores), file]
        done = subprocess.run(words, env=environment, stdout=printed, stderr=subprocess.PIPE, timeout=300)
    assert done.returncode == 0, done.stderr.decode()
    said = pickle.loads(file.read_bytes())
    for number, (constants, (compile_s, answers, most_s, text)) in enumerate(
        zip(runs_of_one_actor(rollout), said, strict=True)
    ):
        (results, report, first_s), (again, _, second_s) = answers
        assert (compile_s == 0.0) == (number == 1), "whose constants are those of the first, whatever the seed"
        alone = make_worker(constants)(work())
        expected = list(map(bits, in_blocks(alone) if cores > 1 else alone))
        assert list(map(bits, results)) == list(map(bits, again)) == expected
        assert text == report.printed.encode() + b"\n" == b"run %d\n" % number
        assert bool(report.spent) == (number == 3)
        assert first_s <= second_s
        if number and rollout == "simd":  # children of xla compute, too
            assert second_s <= most_s + 0.1


def child_program(tmp_path, *arguments, program=PROGRAM):
    file = tmp_path / "program.py"
    file.write_text(textwrap.dedent(program))
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run([sys.executable, file, *arguments], env=environment, capture_output=True, timeout=120)


@pytest.mark.slow
def test_child_processes_with_xla_give_the_results_of_one_core(tmp_path):
    done = child_program(tmp_path)
    assert done.returncode == 0, done.stderr.decode()
    alone = make_worker(spec(rollout="xla", episode_steps=30))(work())
    assert list(map(bits, pickle.loads(done.stdout))) == list(map(bits, alone))


@pytest.mark.slow
@pytest.mark.parametrize(("how", "code"), [pytest.param("lose", 1, marks=pytest.mark.long), ("end", -signal.SIGKILL)])
def test_a_worker_and_its_child_processes_end_together(tmp_path, how, code):
    done = child_program(tmp_path, how)
    assert done.returncode == code, done.stderr.decode()
    assert (b"a child process of this worker has ended" in done.stderr) == (how == "lose")
    children = [int(word) for word in done.stdout.split()]
    assert len(children) == 2
    wait_for(lambda: not any(map(is_running, children)), 10.0)
