"""`bench scaling`: the actor that it measures messages with is one for the engine."""

from __future__ import annotations

import pickle
from operator import attrgetter

import numpy as np

from es_service.dispatch.ray_engine import _read
from es_service.protocol.messages import GradientResult, TrainingChunk
from es_service.protocol.sent import Memory, parcel
from es_service.runs.scaling import EchoActor, _EchoSpec
from tests.helpers import centre, random_parameters, spec


def test_an_echo_is_read_as_the_results_of_a_worker():
    answer = GradientResult(np.arange(3.0, dtype=np.float32))
    echo = _EchoSpec(**vars(spec()), answers={"TrainingChunk": answer})
    actor = EchoActor(pickle.dumps(echo), 0)
    actor.build()
    work = [(centre(random_parameters()), TrainingChunk(1, chunk)) for chunk in range(3)]
    sent = parcel(work, Memory(1 << 30, attrgetter("nbytes")))
    message = pickle.dumps((sent.arrays, sent.origins, sent.work))
    assert _read("compile", actor.compile(message)) >= 0.0
    results, report, seconds = _read("run", actor.run(message))
    assert [result.sum_D.tolist() for result in results] == [[0.0, 1.0, 2.0]] * 3
    assert report is None
    assert seconds > 0.0
    moves, *_ = actor.progress()[0]
    assert isinstance(hash(moves), int)
