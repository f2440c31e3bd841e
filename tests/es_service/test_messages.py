"""What crosses process borders survives it, and what is wrong with it says so."""

import pickle

import numpy as np
import pytest

from es_service import errors, protocol
from tests.helpers import DirectEvaluator, centre, random_parameters, spec

CHUNKS = (
    protocol.TrainingChunk(1, 0),
    protocol.EvaluationChunk(1, 0),
    protocol.GradientChunk(1, 0, np.linspace(-1, 1, 8, dtype=np.float32)),
)


@pytest.mark.parametrize("chunk", CHUNKS, ids=lambda chunk: type(chunk).__name__)
def test_messages_survive_pickling_and_are_small(chunk):
    widest = spec(chunk_pairs=64, rollout_block_pairs=32)
    point = centre(random_parameters())
    [result] = DirectEvaluator(widest).evaluate(point, [chunk])
    for message in (widest, point, chunk, result):
        text = pickle.dumps(message)
        assert pickle.dumps(pickle.loads(text)) == text
        assert len(text) < 100 * 1024
    for name, value in vars(result).items():
        assert isinstance(value, np.ndarray | protocol.Moments | None), name


@pytest.mark.parametrize("kind", [k for k in vars(errors).values() if isinstance(k, type)], ids=lambda k: k.__name__)
def test_errors_survive_pickling(kind):
    error = kind(15) if kind is errors.Interrupted else kind("what is wrong; what to do")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind
    assert again.args == error.args
    assert isinstance(again, errors.ServiceError)
