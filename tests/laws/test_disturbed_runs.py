"""Every method with workers that come, go, fail and answer in any order, with kills at its commits, and as a fork.

Neither changes a bit. The workers are in this process, under the real engine and its scheduler; what a run is killed at
is the copy of its folder at that instant, which is what `kill -9` leaves. Real processes are those of `tests/system`.
A new method takes part by its name.
"""

from __future__ import annotations

import math
import random
import shutil
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import pandas as pd
import pytest

from es_service import api
from es_service.config.keys import has_effect
from es_service.dispatch.engine import Answer, Engine, Message
from es_service.dispatch.events import Compiled, Failure, Limits, WorkerLost, WorkerUp
from es_service.protocol.episodes import Wait
from es_service.protocol.messages import ChunkResult, Work, WorkerSpec
from es_service.search.algorithms import ALGORITHMS
from es_service.store.digest import digest_parts
from es_service.store.reader import read_generation
from tests.helpers import worker_here
from tests.laws.test_readers import QUICK
from tests.laws.test_readers import config_of as config_of_method
from tests.laws.test_recipes import Worker

pytestmark = pytest.mark.usefixtures("workers_here")
GENERATIONS, KEPT = 6, 2
CHANGES = {
    "nsra_es, every centre in each generation": {
        "search": {"algorithm": "nsra_es", "update": "all", "fitness_weight_patience": 1}
    },
    "ars, a linear policy": {"search": {"algorithm": "ars", "shaping": {"count": 5}}, "policy": {"hidden": []}},
    "es, one of two actions": {
        "search": {"algorithm": "es"},
        "task": {"environment": "tests.examples.cart_pole:CartPole", "episode_steps": 40},
        "policy": {"output": "categorical"},
    },
    "es, a policy with a memory": {
        "search": {"algorithm": "es"},
        "task": {"environment": "tests.examples.swing_up:SwingUp", "episode_steps": 20},
        "policy": {"memory": 3},
        "compute": {"inline_workers": "processes"},
    },
    "map_elites, elites measured again": {
        "search": {"algorithm": "map_elites", "elites": {"kind": "eme", "depth": 2, "estimate": "median"}},
        "map": {"correct_every": 2, "correct_episodes": 3},
    },
    "memes, elites measured again": {"search": {"algorithm": "memes", "elites": {"kind": "eme"}}},
    "memes, a dominated map": {"search": {"algorithm": "memes"}, "map": {"kind": "dominated", "slots": 5}},
}
"""Name -> settings of a run that are none of a method's own."""
LONG = ("memes, elites measured again",)
"""Those that only `make long` runs."""
KILLS = ("before_begin", "mid_transaction", "before_commit", "after_commit")
KEPT_PARENTS = 6
"""Parents of policies that a worker keeps: far fewer than it needs."""
FAULTS = ("answers", "answers twice", "fails", "is lost")


def config_of(name: str, **compute: object) -> dict:
    """Config of a method, or of what is in CHANGES, whose generations have several chunks and blocks."""
    changes = CHANGES.get(name, {"search": {"algorithm": name}})
    method = changes["search"]["algorithm"]
    config, settings_of_method = config_of_method(method), ALGORITHMS[method].settings
    small = {"chunk_pairs": 4, "gradient_block_pairs": 4}
    used = {key: value for key, value in small.items() if has_effect(f"compute.{key}", settings_of_method)}
    return config | {
        **{section: config.get(section, {}) | settings for section, settings in changes.items()},
        "budget": {"generations": GENERATIONS},
        "store": {"keep_every": KEPT, "commit_interval_s": 0},
        "compute": config["compute"] | changes.get("compute", {}) | used | compute,
    }


class FaultyWorkers:
    """A Transport whose workers are this process. Which of them is next, and what becomes of it, is drawn at random."""

    def __init__(self, run: Callable[[Sequence[Work]], list[ChunkResult]], rng: random.Random) -> None:
        self.run, self.rng = run, rng
        self.inbox: deque[Message] = deque()
        self.running: list[tuple[int, Hashable, int, Sequence[Work]]] = []
        self.compiled: set[tuple[int, str]] = set()
        self.parents: defaultdict[int, Worker] = defaultdict(lambda: Worker(KEPT_PARENTS))
        self.seen: Counter[str] = Counter()

    def start(self, worker: int) -> None:
        self.inbox.append(WorkerUp(worker))

    def send(self, worker: int, item_id: Hashable, attempt: int, work: Sequence[Work]) -> None:
        self.running.append((worker, item_id, attempt, self.parents[worker].item(work)))

    def receive(self, timeout_s: float) -> Message | None:
        if not self.inbox and timeout_s and self.running:
            self.strike(self.rng.choice(FAULTS))
        return self.inbox.popleft() if self.inbox else None

    def strike(self, fault: str) -> None:
        """Let one of the workers come to the end of its work item, or of itself."""
        self.seen[fault] += 1
        if fault == "is lost":
            worker = self.rng.choice(self.running)[0]
            self.kill(worker)
            self.inbox.append(WorkerLost(worker, "its host is gone"))
            return
        # A worker runs its items in their order.
        worker, item_id, attempt, work = self.rng.choice(list({one[0]: one for one in self.running[::-1]}.values()))
        self.running.remove((worker, item_id, attempt, work))
        kind = type(work[0][1]).__name__
        if (worker, kind) not in self.compiled:
            self.compiled.add((worker, kind))
            self.inbox.append(Compiled(worker, kind, 0.0))
        if fault == "fails":
            self.inbox.append(Failure(worker, item_id, attempt, "no memory"))
        else:
            answer = Answer(worker, item_id, attempt, self.run(work))
            self.inbox.extend([answer] * (1 + (fault == "answers twice")))

    def last_words(self, worker: int) -> str:
        return ""

    def kill(self, worker: int) -> str:
        self.running = [one for one in self.running if one[0] != worker]
        return ""

    def cpu_s(self) -> float:
        return math.nan

    def platforms(self) -> frozenset[str]:
        return frozenset()

    def shortage(self) -> str:
        return ""

    def silent(self) -> tuple[int, ...]:
        return ()

    def close(self) -> None:
        self.running.clear()


class Shuffling(Engine[FaultyWorkers]):
    """Sends the chunks out in any order."""

    def begin(self, work: Sequence[Work]) -> Wait:
        order = self.transport.rng.sample(range(len(work)), len(work))
        wait = super().begin([work[i] for i in order])

        def in_order(most_s: float) -> list[ChunkResult] | None:
            results = wait(most_s)
            return None if results is None else [result for _, result in sorted(zip(order, results, strict=True))]

        return in_order


def named(name: str) -> object:
    marks = pytest.mark.long if name in LONG else () if name in QUICK else pytest.mark.slow
    return pytest.param(name, marks=marks)


@pytest.fixture(scope="module", params=[named(name) for name in (*ALGORITHMS, *CHANGES)])
def whole(request, tmp_path_factory, workers_here):
    """(name, finished run on one worker that nobody disturbs, folders as a kill at each commit would leave them)."""
    folder, kills, committed = tmp_path_factory.mktemp("whole"), [], -1

    def leave_a_copy(at: str) -> None:
        nonlocal committed
        generation = committed + 1
        committed += at == "after_commit"
        if at == KILLS[generation % len(KILLS)]:
            kills.append((committed, folder / f"killed {at} of {generation}"))
            shutil.copytree(folder / "run", kills[-1][1])

    run = api.run(api.load_config(config_of(request.param)), folder / "run", hook=leave_a_copy).run
    return request.param, run, kills


@pytest.fixture(scope="module")
def grouped(whole, tmp_path_factory):
    """Folders as a kill at the first and at the last transaction would leave them, of which most have several
    generations."""
    folder, kills = tmp_path_factory.mktemp("grouped"), {}

    def leave_a_copy(at: str) -> None:
        if at in KILLS:
            kills[at] = folder / f"killed {at}"
            shutil.rmtree(kills[at], ignore_errors=True)
            shutil.copytree(folder / "run", kills[at])

    config = config_of(whole[0])
    config["store"] |= {"commit_interval_s": 0.05}
    return api.run(api.load_config(config), folder / "run", hook=leave_a_copy).run.folder, [*kills.values()]


@pytest.mark.parametrize("workers", [1, 3])
def test_any_number_order_loss_and_retry_of_workers_gives_the_same_bits(whole, tmp_path, monkeypatch, workers):
    name, run, _ = whole
    rng, seen, notices = random.Random(f"{name} {workers}"), Counter(), []

    @contextmanager
    def faulty(
        spec: WorkerSpec, limits: Limits, should_stop: Callable[[], int | None], **_: object
    ) -> Iterator[Engine]:
        at_once = {"max_attempts": 10**6, "max_start_failures": 10**6, "restart_backoff_s": 0.0}
        transport = FaultyWorkers(worker_here(spec), rng)
        with Shuffling(transport, replace(limits, **at_once), should_stop) as engine:
            yield engine
        seen.update(transport.seen)

    monkeypatch.setattr("es_service.runs.engine.inline_engine", faulty)
    other = api.run(api.load_config(config_of(name, workers=workers)), tmp_path / "run", on_notice=notices.append).run
    assert digest_parts(other.folder) == digest_parts(run.folder)
    assert set(other.history["workers"]) == {workers}
    assert other.history["lost_workers"].sum() > 0 < len(notices)
    assert other.history["retries"].sum() > 0
    assert set(seen) == set(FAULTS)


def test_killed_at_any_commit_and_resumed_it_ends_with_the_same_bits(whole, grouped):
    """Before a transaction, in its middle, before and after its commit, by turns; and all at the last one of a run that
    stores several generations in one. `test_store_kills.py` has all of the first one."""
    _, run, kills = whole
    assert [generation for generation, _ in kills] == [-1, 0, 1, 3, 3, 4, 5]
    for generation, folder in kills:
        assert read_generation(folder) == (None if generation < 0 else generation)
    together, of_group = grouped
    assert digest_parts(together) == digest_parts(run.folder)
    *before, after = map(read_generation, of_group)
    assert len({*before}) == 1
    assert after == GENERATIONS
    for folder in (*(folder for _, folder in kills), *of_group[:-1]):
        assert api.resume(folder).run.generation == GENERATIONS
        assert digest_parts(folder) == digest_parts(run.folder), folder.name


def test_a_fork_of_any_kept_generation_that_changes_nothing_has_the_same_bits(whole, tmp_path):
    _, run, _ = whole
    for generation in (0, KEPT, 2 * KEPT, GENERATIONS - 1):
        out = tmp_path / str(generation)
        fork = api.fork(run.folder, [f"budget.generations={GENERATIONS}"], out=out, generation=generation).run
        assert digest_parts(fork.folder) == digest_parts(run.folder)
        pd.testing.assert_frame_equal(fork.evaluations, run.evaluations)


def test_a_fork_of_ars_with_other_top_pairs_differs_from_its_first_step_on(tmp_path):
    run = api.run(api.load_config(config_of("ars, a linear policy")), tmp_path / "run").run
    changes = [f"budget.generations={GENERATIONS}", "search.shaping.count=3"]
    fork = api.fork(run.folder, changes, out=tmp_path / "fork", generation=KEPT).run
    same = fork.history["centre_return_mean"] == run.history["centre_return_mean"]
    assert same.index[~same].tolist() == [*range(KEPT + 1, GENERATIONS + 1)]


def test_another_seed_gives_other_bits(whole, tmp_path):
    """Or equal digests would say nothing."""
    name, run, _ = whole
    other = api.run(api.load_config(config_of(name) | {"seed": 1}), tmp_path / "run").run
    assert digest_parts(other.folder) != digest_parts(run.folder)
