"""Fresh episodes of stored policies: their statistics, and the memory that they take."""

from __future__ import annotations

import contextlib
import weakref

import numpy as np
import pytest

from es_service.api import open_run
from es_service.protocol.episodes import DispatchCounts, addressed
from es_service.protocol.messages import EpisodesResult, EvaluationChunk
from es_service.runs import evaluation
from tests.run_examples import write_run

SEVERAL = 7


class Invented:
    """An evaluator whose episodes are invented from their numbers; it counts the results that are alive."""

    counts = DispatchCounts(workers=1)

    def __init__(self, wrong: float | None = None) -> None:
        self.alive, self.most, self.seen, self.wrong = 0, 0, [], wrong

    def evaluate(self, work):
        return [addressed((subject, chunk), self._result(chunk)) for subject, chunk in work]

    def _result(self, chunk: EvaluationChunk) -> EpisodesResult:
        number_E = chunk.chunk_id * 16 + np.arange(chunk.episodes)
        self.seen += number_E.tolist()
        fitness_E, descriptor_E_B = invented(number_E)
        if self.wrong is not None:
            fitness_E[number_E == 3] = self.wrong
        steps_E, outputs = np.ones(len(number_E), np.int32), {"success": number_E % 3 == 0}
        result = EpisodesResult(fitness_E, fitness_E, descriptor_E_B, steps_E, descriptor_E_B, None, outputs=outputs)
        weakref.finalize(result, self._gone)
        self.alive += 1
        self.most = max(self.most, self.alive)
        return result

    def _gone(self) -> None:
        self.alive -= 1


def invented(number_E: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    fitness_E = np.sin(number_E * 12.9898).astype(np.float32) * 100.0 - 30.0
    return fitness_E, np.stack([np.cos(number_E * 78.233), np.sin(number_E * 37.719)], axis=1).astype(np.float32)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return open_run(write_run(tmp_path_factory.mktemp("evaluation") / "run"))


def evaluated(run, monkeypatch, episodes: int, *, every: bool = False, wrong: float | None = None):
    """The statistics of each policy, and the evaluator."""
    made = Invented(wrong)
    monkeypatch.setattr(evaluation, "engine_here", lambda *_, **__: contextlib.nullcontext(made))
    chosen = evaluation.candidates(run, best=not every, centre=False, cells=(), every=every)
    return list(evaluation.evaluate(run, chosen, episodes)), made


def test_memory_does_not_grow_with_the_number_of_episodes(run, monkeypatch):
    """A number of episodes that nobody has time for begins at once, and can be ended."""
    monkeypatch.setattr(evaluation, "EPISODES_AT_ONCE", 64)
    few, many = (evaluated(run, monkeypatch, episodes)[1] for episodes in (64 * SEVERAL, 64 * SEVERAL * 40))
    assert many.most == few.most <= 2 * 4, "chunks of 64 episodes and of the 64 before"
    assert many.seen == list(range(64 * SEVERAL * 40))

    class Interrupted(BaseException):
        pass

    def interrupted(self, work):
        assert len(work) == 4
        raise Interrupted

    monkeypatch.setattr(Invented, "evaluate", interrupted)
    with pytest.raises(Interrupted):
        evaluated(run, monkeypatch, 10**9)


@pytest.mark.parametrize("episodes", [1, 2, 50, 9000, evaluation.EPISODES_AT_ONCE])
def test_statistics_are_those_of_all_episodes_in_one_array(run, monkeypatch, episodes):
    """Bit for bit, as far as the episodes are in memory together."""
    [fresh], _ = evaluated(run, monkeypatch, episodes)
    fitness_E, descriptor_E_B = invented(np.arange(episodes))
    assert fresh.episodes == episodes
    assert fresh.mean == fitness_E.mean(dtype=np.float64)
    if episodes > 1:
        assert fresh.standard_error == fitness_E.std(dtype=np.float64, ddof=1) / np.sqrt(episodes)
    else:
        assert np.isnan(fresh.standard_error)
    np.testing.assert_array_equal(fresh.descriptor, descriptor_E_B.mean(axis=0, dtype=np.float64), strict=True)
    np.testing.assert_array_equal(fresh.descriptor_std, descriptor_E_B.std(axis=0, dtype=np.float64), strict=True)


def test_statistics_in_pieces_differ_in_their_last_bits_only(run, monkeypatch):
    episodes = 16 * 4 * SEVERAL + 5
    [whole], _ = evaluated(run, monkeypatch, episodes)
    monkeypatch.setattr(evaluation, "EPISODES_AT_ONCE", 64)
    [pieces], _ = evaluated(run, monkeypatch, episodes)
    for name in ("mean", "standard_error", "descriptor", "descriptor_std"):
        np.testing.assert_allclose(getattr(pieces, name), getattr(whole, name), rtol=1e-12)
    assert pieces.cell == whole.cell
    assert pieces.successes == whole.successes == len(range(0, episodes, 3))


@pytest.mark.parametrize("wrong", [np.inf, np.nan])
def test_an_episode_without_a_finite_fitness_is_seen_in_the_mean(run, monkeypatch, wrong):
    monkeypatch.setattr(evaluation, "EPISODES_AT_ONCE", 64)
    [fresh], _ = evaluated(run, monkeypatch, 200, wrong=wrong)
    assert not np.isfinite(fresh.mean)
    assert np.isfinite(fresh.descriptor).all()


def test_elites_are_evaluated_side_by_side_on_the_same_episodes(run, monkeypatch):
    found, _ = evaluated(run, monkeypatch, 20, every=True)
    assert len(found) > 10
    assert len({fresh.mean for fresh in found}) == 1
