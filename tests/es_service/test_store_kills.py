"""A process killed at any instant: what was committed is there, and the run continues with the same bits."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from es_service.errors import StoreError
from es_service.protocol.content import name_of
from es_service.store import reader
from es_service.store import writer as store
from es_service.store.reader import read_certifications, read_generation, read_history
from es_service.store.writer import RunStore
from tests.es_service.store_examples import (
    OTHER,
    advance,
    assert_same_history,
    assert_same_state,
    assert_sound,
    certified,
    copy_at_every_commit,
    create,
    digest,
    finished,
    policy,
    state_at,
)
from tests.es_service.store_killer import GENERATIONS

ROOT = Path(__file__).parents[2]


def killed(tmp_path, jobs):
    """Names of the jobs that were killed; the others ended by themselves, well."""
    program = subprocess.run(
        [sys.executable, "-m", "tests.es_service.store_killer", str(tmp_path)],
        input="".join(f"{' '.join(map(str, job))}\n" for job in jobs),
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        check=True,
        timeout=120,
    )
    ends = dict(line.split() for line in program.stdout.splitlines())
    assert set(ends.values()) <= {"killed", "0"}, program.stderr
    return {name for name, end in ends.items() if end == "killed"}


# A checkpoint follows each transaction. Of one generation, or of three.
KILLS = [
    ("opened", 1, 1, -1),
    *((hook, count, 1, count - 2) for hook in ("before_begin", "mid_transaction", "before_commit") for count in (1, 5)),
    *(("after_commit", count, 1, count - 1) for count in (1, 6)),
    *((hook, 2, 3, 2) for hook in ("before_begin", "mid_transaction", "before_commit")),
    *(("after_commit", count, 3, 3 * count - 1) for count in (1, 2)),
]
"""(instant, how often it is reached, generations of a transaction, newest generation then)."""


@pytest.mark.slow
def test_a_killed_writer_loses_the_transaction_in_flight_and_nothing_else(tmp_path):
    jobs = [("hook", "-".join(map(str, job[:3])), *job[:3]) for job in KILLS]
    checkpoints = [
        (f"{hook}-{count}", hook, count, 1) for hook in ("before_checkpoint", "after_checkpoint") for count in (1, 2)
    ]
    jobs += [("hook", *checkpoint) for checkpoint in checkpoints]
    assert killed(tmp_path, jobs) == {job[1] for job in jobs}
    expected_digest = digest(finished(tmp_path / "uninterrupted", GENERATIONS))
    for hook, count, together, generation in KILLS:
        assert_sound(tmp_path / f"{hook}-{count}-{together}", generation)
    reached = {name: read_generation(tmp_path / name) for name, *_ in checkpoints}
    assert reached["before_checkpoint-1"] == reached["after_checkpoint-1"]
    assert reached["before_checkpoint-1"] < reached["before_checkpoint-2"] <= GENERATIONS - 1
    for name, generation in reached.items():
        assert_sound(tmp_path / name, generation)
    for _, name, *_ in jobs:
        with RunStore.open(tmp_path / name) as run:
            advance(run, GENERATIONS - 1)
        assert digest(tmp_path / name) == expected_digest


@pytest.mark.slow
def test_a_creation_killed_at_any_file_operation_can_be_continued_or_repeated(tmp_path):
    names = [f"{kind}-{count}" for kind in ("new", "existing") for count in range(1, 30)]
    for name in names:
        if name.startswith("existing"):
            (tmp_path / name).mkdir()
    died = killed(tmp_path, [("create", name, "-", name.split("-")[1], 1) for name in names])
    assert {"new-1", "new-10", "existing-1", "existing-10"} <= died < set(names)
    outcomes = set()
    for name in names:
        folder = tmp_path / name
        if (folder / "run.db").exists():
            outcomes.add(("resumed", name in died))
            with RunStore.open(folder) as run:
                assert run.generation is None
                assert (folder / "config.yaml").read_text() == "seed: 0\n"
                advance(run, 0)
        else:
            outcomes.add(("repeated", name in died))
            assert folder.exists() is name.startswith("existing")
            if folder.exists():
                with pytest.raises(StoreError, match="nothing was lost; start the run again"):
                    RunStore.open(folder)
            create(folder, generations=1).close()
        assert_sound(folder, 0)
        assert sorted(path.name for path in folder.iterdir()) == ["config.yaml", "run.db", "run.lock"]
    assert outcomes == {("resumed", True), ("repeated", True), ("resumed", False)}
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names)


@pytest.mark.slow
def test_a_repair_killed_at_any_file_operation_can_be_done_again(tmp_path, monkeypatch):
    # The file itself holds the empty run, all generations are in the log beside it, and one of them is damaged there:
    # taken apart, the two would be an empty run, or the log would be replayed into the copy.
    copy_at_every_commit(monkeypatch)
    with create(tmp_path / "whole", generations=3) as run:
        run._connection.execute("UPDATE history SET env_steps = 7 WHERE generation = 1")
        shutil.copytree(tmp_path / "whole", tmp_path / "killed")
    names = [f"open-{count}" for count in range(1, 40)]
    for name in names:
        shutil.copytree(tmp_path / "killed", tmp_path / name)
    died = killed(tmp_path, [("open", name, "-", name.split("-")[1], 1) for name in names])
    assert {"open-1", "open-10"} <= died < set(names)
    for name in names:
        with RunStore.open(tmp_path / name) as run:
            assert run.generation == 2
            assert_same_state(run.load(), state_at(2))
            assert len(run.notices) <= 1
        assert (tmp_path / name / "run.db.damaged").exists()
        assert not list((tmp_path / name).glob("run.db.restored*"))
        assert_sound(tmp_path / name, 2)


@pytest.mark.slow
def test_of_a_certification_that_was_killed_there_is_all_or_nothing(tmp_path):
    hooks = ("mid_transaction", "before_commit", "after_commit", "before_checkpoint", "after_checkpoint")
    create(tmp_path / "whole", generations=2).close()
    for hook in hooks:
        shutil.copytree(tmp_path / "whole", tmp_path / hook)
    assert killed(tmp_path, [("certify", hook, hook, 1, 1) for hook in hooks]) == {*hooks}
    for number, hook in enumerate(hooks):
        is_stored = number >= 2
        with RunStore.open(tmp_path / hook) as run:
            assert run.next_certification == is_stored
            assert run.notices == []
            for _ in range(2 - is_stored):
                run.add_certification(*certified(OTHER, policy(0)))
        found = read_certifications(tmp_path / hook)
        assert [(row.number, row.rank, [*row.contents]) for row in found] == [
            (number, rank, [name_of(content)]) for number in (0, 1) for rank, content in enumerate((OTHER, policy(0)))
        ]
        assert_sound(tmp_path / hook, 1)
        assert digest(tmp_path / hook) == digest(tmp_path / "whole")


def test_on_a_network_a_killed_writer_loses_no_more(tmp_path, monkeypatch):
    for module in (store, reader):
        monkeypatch.setattr(module, "is_network_filesystem", lambda path: True)
    jobs = [job for job in KILLS if job[1] > 1]
    died = killed(tmp_path, [("network", "-".join(map(str, job[:3])), *job[:3]) for job in jobs])
    assert len(died) == len(jobs)
    for hook, count, together, generation in jobs:
        folder = tmp_path / f"{hook}-{count}-{together}"
        before = {path.name: path.read_bytes() for path in folder.iterdir()}
        # A journal to be rolled back sends readers to the copy, which here is as new.
        assert ("run.db-journal" in before) is (hook in ("mid_transaction", "before_commit"))
        assert_same_history(read_history(folder), generation + 1)
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
        assert_sound(folder, generation)
