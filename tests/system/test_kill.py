"""`kill -9` at any instant, then resume: the run ends with the same bits as one that was never touched."""

from __future__ import annotations

import random
import shutil
import signal
import time

import pytest

from es_service.store.digest import digest_parts
from es_service.store.reader import read_generation
from tests.system.processes import committed, wait_until
from tests.system.session import SMALL, finish, start

SEARCH = {"algorithm": "me_es", "pairs": 16, "evaluation_episodes": 4, "block_generations": 5}
LONG = SMALL | {"search": SEARCH, "budget": {"generations": 3000}}
"""ME-ES: a map, an elite drawn from the store every five generations, a fresh optimiser for each block."""


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """Digest of the run that nobody disturbs."""
    folder = tmp_path_factory.mktemp("reference") / "run"
    assert finish(folder, config=SMALL) == 0
    return digest_parts(folder)


HOOKS = [  # where a session is killed, at which passage of that point, and the newest generation then
    ("before_begin", 1, None),
    ("mid_transaction", 3, 1),
    ("before_commit", 4, 4),
    ("after_commit", 4, 8),
    ("opened", 1, 8),
    ("before_checkpoint", 1, 30),  # in so short a session: at its end, or after five seconds of a busy machine
]
ALONE = SMALL | {"store": {"commit_interval_s": 0}}


def test_killed_at_each_hook_in_turn(tmp_path, reference):
    """Of one run. `laws/test_disturbed_runs.py` has every commit of every method."""
    folder = tmp_path / "run"
    for at, nth, newest in HOOKS:
        config = None if folder.exists() else ALONE
        assert finish(folder, config=config, kill={"at": at, "nth": nth}) == -signal.SIGKILL
        reached = read_generation(folder)
        assert reached == newest or (at == "before_checkpoint" and 8 <= (reached or 0) < newest)
    assert finish(folder) == 0
    assert digest_parts(folder) == reference


def test_killed_where_several_generations_are_stored_together(tmp_path, reference):
    """What is in the transaction in flight is lost, and nothing before it."""
    folder = tmp_path / "run"
    assert finish(folder, config=SMALL, kill={"at": "after_commit"}) == -signal.SIGKILL
    reached = read_generation(folder)
    assert reached is not None
    if reached < 29:  # on most machines, the first transaction has some of them
        for at in ("mid_transaction", "before_commit"):
            assert finish(folder, kill={"at": at}) == -signal.SIGKILL
            assert read_generation(folder) == reached
    assert finish(folder) == 0
    assert digest_parts(folder) == reference


def checkpoint_in_progress(folder) -> bool:
    """Whether the process died with a checkpoint begun and not ended: SQLite's own note in the shared memory file.

    The WAL index keeps, at bytes 96 and 128, how many frames are known to be in the database and how many a checkpoint
    has begun to move there (SQLite file format, "WAL-index header").
    """
    try:
        index = (folder / "run.db-shm").read_bytes()
    except FileNotFoundError:  # the session had ended before
        return False
    moved, attempted = (int.from_bytes(index[at : at + 4], "little") for at in (96, 128))
    return attempted > moved


@pytest.mark.alone
def test_killed_during_a_wal_checkpoint(tmp_path, reference):
    """Each session finds a run whose last one was killed before its checkpoint, and has nothing else left to do."""
    killed, hits = tmp_path / "killed", 0
    assert finish(killed, config=SMALL, kill={"at": "before_checkpoint"}) == -signal.SIGKILL
    for trial in range(40):
        folder = shutil.copytree(killed, tmp_path / f"run{trial}")
        kill = {"at": "before_checkpoint", "after_us": 20 * trial}
        assert finish(folder, kill=kill) == -signal.SIGKILL
        if checkpoint_in_progress(folder):
            hits += 1
            assert finish(folder) == 0
            assert digest_parts(folder) == reference
        if hits == 2:
            return
    pytest.fail(f"{hits} of 40 kills fell into a checkpoint; widen the delays")


@pytest.mark.alone
def test_killed_during_start_up(tmp_path, reference):
    """At any instant from nothing to the first commit: either there is no run yet, or it can be resumed. What is left
    of a folder before keeps nobody from starting the run in it."""
    kills = 0

    def killed(after_s: float, *, since_creation: bool) -> bool:
        """Kill a session of its own at that instant, and finish what it has begun; whether a run had begun."""
        nonlocal kills
        kills += 1
        folder = tmp_path / f"run{kills}"
        with start(folder, config=SMALL) as process:
            if since_creation:
                wait_until(process, (folder / "run.db").exists)
            time.sleep(after_s)
        begun = (folder / "run.db").exists()
        if folder.exists():
            assert finish(folder, config=None if begun else SMALL) == 0
            assert digest_parts(folder) == reference
        return begun

    delay_s = 0.1
    while not killed(delay_s, since_creation=False):  # later and later, until one comes after the run's creation
        delay_s *= 1.3
    assert kills >= 4
    for after_s in (0.0, 0.01, 0.03):
        assert killed(after_s, since_creation=True)


@pytest.mark.long
def test_killed_in_every_generation_of_two_blocks(tmp_path):
    blocks = ALONE | {"search": SEARCH, "budget": {"generations": 11}}
    assert finish(tmp_path / "undisturbed", config=blocks) == 0
    folder = tmp_path / "run"
    for generation in range(11):
        kill = {"at": "before_commit" if generation % 2 else "after_commit", "nth": 2 if generation % 2 else 1}
        assert finish(folder, config=None if generation else blocks, kill=kill) == -signal.SIGKILL
        assert committed(folder) == generation
    assert finish(folder) == 0
    assert digest_parts(folder) == digest_parts(tmp_path / "undisturbed")


@pytest.mark.long
def test_killed_fifty_times_in_one_run(tmp_path):
    """Fifty SIGKILLs at random instants of one run, at least forty of them between its first commit and its end."""
    undisturbed, folder = tmp_path / "undisturbed", tmp_path / "run"
    assert finish(undisturbed, config=LONG) == 0
    rng = random.Random(0)
    between = 0
    for kill in range(50):
        before = committed(folder)
        with start(folder, config=LONG if not (folder / "run.db").exists() else None) as process:
            if kill % 10 == 9:  # some before this session commits anything
                time.sleep(rng.uniform(0.2, 1.5))
            else:
                wait_until(process, lambda before=before: committed(folder) != before)
                time.sleep(rng.uniform(0.0, 0.03))
            assert process.poll() is None, "the run ended before its kill; give it more generations"
        between += committed(folder) is not None
    assert between >= 40
    print(
        f"{between} of 50 kills fell between the first commit and the end, at generation {committed(folder)} of 3,000"
    )
    assert finish(folder) == 0
    assert digest_parts(folder) == digest_parts(undisturbed)
