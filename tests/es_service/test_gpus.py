"""The GPUs of this machine and the workers that use them, by what CUDA_VISIBLE_DEVICES is in each child process."""

from __future__ import annotations

import os

import numpy as np
import pytest

from es_service import load_config
from es_service.config.tasks import task_of
from es_service.config.workload import worker_spec
from es_service.dispatch.events import Limits
from es_service.dispatch.inline_engine import inline_engine
from es_service.protocol import machine
from es_service.protocol.machine import places
from es_service.protocol.messages import TrainingChunk
from tests.helpers import centre


@pytest.mark.parametrize(
    ("visible", "share", "expected"),
    [
        ("0,1,2", 1, ("0", "1", "2")),
        ("0,1,2", 2, ("0,1",)),
        ("3, GPU-5f", 0.5, ("3", "3", "GPU-5f", "GPU-5f")),
        ("3", 0.4, ("3", "3")),
        ("2,-1,3", 1, ("2",)),
        ("", 1, ()),
        ("0", 2, ()),
    ],
)
def test_workers_have_as_many_places_as_visible_gpus_have_room(visible, share, expected):
    assert places({"CUDA_VISIBLE_DEVICES": visible}, share) == expected


def test_all_gpus_are_visible_unless_the_environment_names_some(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "DEVICES", tmp_path)
    assert places({}, 1) == ()
    for name in ("nvidia3", "nvidia0", "nvidiactl", "nvidia-uvm"):
        (tmp_path / name).touch()
    assert places({}, 1) == ("0", "1"), "their numbers in CUDA count from 0, also in a container that has others"


def its_gpu(parameters):
    """The number of the GPU that this process may use."""
    assert os.environ["JAX_PLATFORMS"] == "cuda"
    assert os.environ["XLA_CLIENT_MEM_FRACTION"] == "0.45"
    return float(os.environ["CUDA_VISIBLE_DEVICES"])


its_gpu.parameters = 2
its_gpu.deterministic = True


@pytest.mark.slow
def test_a_new_worker_takes_the_place_of_one_that_was_lost(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5,8")
    search = {"algorithm": "es", "pairs": 8}
    config = load_config(
        {
            "task": {"environment": f"function:{__name__}:its_gpu"},
            "search": search,
            "budget": {"generations": 1},
            "map": {"enabled": False},
            "compute": {"chunk_pairs": 1},
        }
    )
    spec = worker_spec(config, task_of(config))
    work = [(centre(np.zeros(2, np.float32)), TrainingChunk(0, chunk)) for chunk in range(8)]
    with inline_engine(spec, Limits(4, item_s=0.0), gpus=0.5) as engine:

        def gpus_of_workers():
            engine.evaluate(work)
            return sorted(worker.place for worker in engine.transport._workers.values())

        assert gpus_of_workers() == ["5", "5", "8", "8"]
        first = min(engine.transport.process_ids())
        os.kill(engine.transport.process_ids()[first], 9)
        while first in engine.transport.process_ids():
            engine.evaluate(work)
        assert gpus_of_workers() == ["5", "5", "8", "8"]
        returns = {float(value) for result in engine.evaluate(work) for value in np.unique(result.returns)}
        assert returns <= {5.0, 8.0}
