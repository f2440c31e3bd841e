"""What crosses process borders survives it, and what is wrong with it says so."""

import pickle

import numpy as np
import pytest

from es_service import errors
from es_service.protocol import messages
from tests.helpers import DirectEvaluator, centre, random_parameters, spec

CHUNKS = (
    messages.TrainingChunk(1, 0),
    messages.EvaluationChunk(1, 0),
    messages.GradientChunk(1, 0, np.linspace(-1, 1, 8, dtype=np.float32)),
)
ERRORS = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, BaseException)]


@pytest.mark.parametrize("chunk", CHUNKS, ids=lambda chunk: type(chunk).__name__)
def test_messages_survive_pickling_and_are_small(chunk):
    widest = spec(chunk_pairs=64, rollout_block_pairs=32)
    point = centre(random_parameters())
    [result] = DirectEvaluator(widest).evaluate([(point, chunk)])
    for message in (widest, point, chunk, result):
        text = pickle.dumps(message)
        assert pickle.dumps(pickle.loads(text)) == text
        assert len(text) < 100 * 1024
    besides = {"outputs": None, "of_steps": None, "failures": None, **getattr(result, "outputs", {})}
    for name, value in (vars(result) | besides).items():
        assert isinstance(value, np.ndarray | messages.Moments | int | None), name


def test_an_evaluation_asks_for_no_more_episodes_than_are_wanted():
    for episodes, sizes in ((2, [2]), (16, [16]), (35, [16, 16, 3])):
        chunks = messages.evaluation_chunks(7, episodes, first=4, ask=1)
        assert [chunk.episodes for chunk in chunks] == sizes
        assert [(chunk.generation, chunk.chunk_id, chunk.ask) for chunk in chunks] == [
            (7, 4 + i, 1) for i in range(len(sizes))
        ]


@pytest.mark.parametrize("kind", ERRORS, ids=lambda k: k.__name__)
def test_errors_survive_pickling(kind):
    if kind is errors.Interrupted:
        error = kind(15)
    else:
        way_out = errors.WayOut("fork", "go on", "runs/a", {"search.sigma": 0.1})
        error = kind("what is wrong", field="search.sigma", value=7, run="runs/a", ways_out=[way_out])
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind
    assert (again.args, vars(again), str(again)) == (error.args, vars(error), str(error))
    assert isinstance(again, Exception) == isinstance(again, errors.ServiceError) == (kind is not errors.Interrupted)
