"""Computing a run again: equal bits, a bit that a worker flipped, and what has changed since."""

from __future__ import annotations

import json
from contextlib import contextmanager

import numpy as np
import pytest
import typer

from es_service import api
from es_service.cli import session as command
from es_service.config.workload import worker_spec
from es_service.errors import ConfigError, NotInRunError, RunLockedError
from es_service.protocol.messages import EpisodesResult, GradientResult
from es_service.runs import evaluation, session, verification
from es_service.runs.verification import verify
from es_service.store.lock import acquire_lock
from tests.helpers import DirectEvaluator
from workers.environments import SHIPPED

CONFIG = {
    "task": {"environment": "point_maze", "episode_steps": 20},
    "policy": {"hidden": [4]},
    "search": {"algorithm": "me_es", "pairs": 16, "evaluation_episodes": 4, "block_generations": 3, "emitters": 2},
    "budget": {"generations": 12},
    "compute": {"engine": "inline", "workers": 1, "rollout": "simd", "chunk_pairs": 8, "gradient_block_pairs": 8},
    "store": {"keep_every": 4},
}


class Worker(DirectEvaluator):
    """A worker of this process, in which a bit of one result can be flipped."""

    platforms: frozenset[str] = frozenset()

    def __init__(self, spec):
        super().__init__(spec)
        self.generations: set[int] = set()
        """Generations of which it has computed something."""
        self.flip = None
        """(generation, kind of result, name of its array) in which the next result has a wrong bit."""

    def wait_for_place(self):
        """Return at once."""

    def begin(self, work):
        results = self.evaluate(work)
        return lambda most_s: results

    def evaluate(self, work):
        self.generations.update(chunk.generation for _, chunk in work)
        results = super().evaluate(work)
        for (_, chunk), result in zip(work, results, strict=True):
            if self.flip and self.flip[0] == chunk.generation and isinstance(result, self.flip[1]):
                wrong = getattr(result, self.flip[2]).view(np.uint32)
                wrong.flat[1] ^= 1 << 20
                self.flip = None
        return results


@pytest.fixture(scope="module")
def worker():
    return Worker(worker_spec(api.load_config(CONFIG), SHIPPED["point_maze"]))


@pytest.fixture(autouse=True)
def engine(worker, monkeypatch):
    @contextmanager
    def ours(*_, **__):
        yield worker

    monkeypatch.setattr(session, "make_engine", ours)
    monkeypatch.setattr(verification, "engine_here", ours)


def computed(folder, *overrides):
    return api.run(api.load_config(CONFIG, overrides), folder, on_notice=pytest.fail).run


def spans(found):
    return [(one.first, one.last) for one in found]


def test_a_sound_run_is_equal_however_much_of_it_is_computed(tmp_path):
    run = computed(tmp_path / "run")
    some, most, whole = (list(verify(run, generations)) for generations in (1, 3, 1000))
    assert spans(some) == [(0, 0), (1, 1), (5, 5), (9, 9), (12, 12)]
    assert spans(most) == [(0, 0), (1, 3), (5, 7), (9, 11), (12, 12)]
    assert spans(whole) == [(0, 0), (1, 4), (5, 8), (9, 11), (12, 12)]
    assert {(one.differences, one.changes) for one in some + most + whole} == {((), ())}


def test_a_run_that_keeps_no_more_than_it_must_can_be_computed_from_its_start(tmp_path, worker):
    run = computed(tmp_path / "run", "store.keep_every=null")
    found = list(verify(run, 1000))
    assert spans(found) == [(0, 11), (12, 12)]
    worker.generations.clear()
    assert spans(verify(run, 3)) == [(0, 2), (12, 12)]
    assert worker.generations == {0, 1, 2, 12}, "nothing beyond the last one that is compared"
    assert not any(one.differences for one in found)


@pytest.mark.parametrize(
    ("kind", "array", "named"),
    [
        (EpisodesResult, "fitness", "fitness"),
        (EpisodesResult, "descriptor", "state"),
        (GradientResult, "sum_D", "state"),
    ],
)
def test_a_bit_that_a_worker_flipped_is_found_in_its_generation(tmp_path, worker, kind, array, named):
    worker.flip = (7, kind, array)
    run = computed(tmp_path / "run")
    assert worker.flip is None
    found = list(verify(run, 1000))
    assert spans(found) == [(0, 0), (1, 4), (5, 7), (9, 11), (12, 12)]
    assert [bool(one.differences) for one in found] == [False, False, True, False, False]
    assert named in ", ".join(found[2].differences)


def test_a_bit_that_is_flipped_now_is_found_as_well_and_the_part_is_named(tmp_path, worker):
    run = computed(tmp_path / "run")
    worker.flip = (12, GradientResult, "sum_D")
    *before, last = verify(run)
    assert not any(one.differences for one in before)
    assert last.last == 12
    parts = [name for name in last.differences if name.startswith("state/")]
    assert any(name.startswith("state/centres/") for name in parts)
    assert not {"state/map/geometry#000000", "state/observations"} & set(parts)
    assert any(" instead of " in name for name in last.differences)


def test_what_computed_the_run_otherwise_is_told_of_equal_and_of_other_bits(tmp_path, worker, monkeypatch):
    run = computed(tmp_path / "run")
    now, code = verification.platform_info(), dict(verification.code_of(api.load_config(CONFIG)))
    monkeypatch.setattr(verification, "platform_info", lambda: {**now, "jax": "99.0"})
    monkeypatch.setattr(verification, "code_of", lambda config: {**code, "workers/policy.py": "another"})
    worker.flip = (12, GradientResult, "sum_D")
    for one in verify(run):
        assert one.changes == (f"jax {now['jax']} -> 99.0", "other code in workers/policy.py")
        assert bool(one.differences) is (one.last == 12)


def test_a_fork_is_computed_from_what_it_keeps_and_a_run_from_a_policy_from_its_start(tmp_path, noticed):
    parent = computed(tmp_path / "parent")
    fork = api.fork(parent.folder, {"budget.generations": 15}, generation=8, out=tmp_path / "fork").run
    found = list(verify(fork, 1000))
    assert spans(found) == [(9, 12), (13, 14), (15, 15)]
    started = computed(tmp_path / "started", f"search.init_from={parent.folder}", "budget.generations=5")
    found += list(verify(started, 1000))
    assert spans(found[3:]) == [(0, 0), (1, 4), (5, 5)]
    assert not any(one.differences for one in found)
    idle = api.fork(parent.folder, out=tmp_path / "idle").run
    assert noticed[-1].startswith("note: no generation was run")
    with pytest.raises(NotInRunError, match="no generation that can be computed again"):
        list(verify(idle))


def test_a_run_that_is_being_written_cannot_be_verified_now(tmp_path, capsys):
    """Its driver deletes the states that verification needs. The exit code says neither equal nor different."""
    run = computed(tmp_path / "run", "budget.generations=1")
    lock = acquire_lock(run.folder)
    with pytest.raises(RunLockedError, match="is being written by process"):
        verify(run)
    with pytest.raises(typer.Exit) as ended:
        command.verify(run.folder)
    lock.release()
    assert ended.value.exit_code == 3
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "is being written by process" in printed.err
    assert len(list(verify(run))) == 2


@pytest.mark.parametrize(
    "use",
    [
        lambda run: list(verify(run)),
        evaluation.evaluation_config,
        lambda run: api.fork(run.folder, out=run.folder.with_name("fork")),
        lambda run: api.resume(run.folder),
    ],
    ids=["verify", "evaluate", "fork", "resume"],
)
def test_whoever_uses_the_config_of_a_run_names_its_file_if_it_is_wrong(tmp_path, use):
    run = computed(tmp_path / "run", "budget.generations=1")
    file = run.folder / "config.yaml"
    file.write_text(file.read_text().replace("generations: 1", "generations: -1"))
    with pytest.raises(ConfigError, match=r"budget\.generations: -1 ") as caught:
        use(run)
    assert caught.value.sentence.startswith(f"{file}: 1 problem\n")


@pytest.mark.parametrize("as_json", [False, True])
def test_the_command_says_which_generation_and_ends_with_1(tmp_path, worker, capsys, as_json):
    worker.flip = (7, GradientResult, "sum_D")
    run = computed(tmp_path / "run")
    with pytest.raises(typer.Exit) as ended:
        command.verify(run.folder, generations=1000, as_json=as_json)
    assert ended.value.exit_code == 1
    printed = capsys.readouterr().out
    if as_json:
        said = json.loads(printed)
        assert (said["digest"], said["equal"]) == (run.digest(), False)
        assert [(one["last"], bool(one["differences"])) for one in said["recomputed"]] == [
            (0, False),
            (4, False),
            (7, True),
            (11, False),
            (12, False),
        ]
    else:
        assert "generations 1 to 4: equal\ngenerations 5 to 7: generation 7 differs: " in printed
        assert printed.endswith(f"{run.digest()}  different\n")
