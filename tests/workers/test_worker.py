"""A worker's chunks together: the same results as of each chunk alone, in the order in which they were given."""

from __future__ import annotations

import numpy as np
import pytest

from es_service.protocol.messages import EvaluationChunk, GradientChunk, TrainingChunk
from tests.helpers import centre, chunk_runner, random_parameters, spec
from workers.simd.episodes import rollout
from workers.simd.episodes.compiled import EpisodeKernel
from workers.worker import make_worker


def work():
    """Several chunks of each kind around two centres, not in the order of their ids."""
    first, second = centre(random_parameters(1)), centre(random_parameters(2), sigma=0.3)
    weights = np.random.default_rng(0).normal(size=(4, 8)).astype(np.float32)
    return [
        *[(first, TrainingChunk(1, chunk)) for chunk in (2, 0, 1)],
        *[(second, TrainingChunk(1, chunk, ask=1)) for chunk in (0, 1)],
        (first, TrainingChunk(2, 0)),
        *[(first, EvaluationChunk(1, chunk, episodes=episodes)) for chunk, episodes in ((0, 16), (1, 3))],
        *[(second, EvaluationChunk(1, chunk, ask=1)) for chunk in (1, 0)],
        *[(first, GradientChunk(1, chunk, weights[chunk])) for chunk in (0, 1)],
        *[(second, GradientChunk(1, chunk, weights[2 + chunk], ask=1)) for chunk in (0, 1)],
    ]


def bits(result):
    moments = getattr(result, "moments", None)
    leaves = [*vars(result).values(), *(vars(moments).values() if moments is not None else ())]
    return [np.asarray(leaf).tobytes() for leaf in leaves if isinstance(leaf, np.ndarray | float)]


@pytest.mark.parametrize("how", ["simd", "xla"])
def test_chunks_together_are_the_same_as_each_alone(how):
    worker_spec = spec(rollout=how, episode_steps=30)
    alone = chunk_runner(worker_spec)
    together = make_worker(worker_spec)(work())
    for (point, chunk), result in zip(work(), together, strict=True):
        if not isinstance(chunk, GradientChunk):
            assert bits(result) == bits(alone(point, chunk)), chunk
    blocks = [alone(*one).sum_D for one in work()[-4:]]
    assert [result.blocks for result in together[-4:]] == [2, 0, 2, 0]
    for result, first, second in zip(together[-4::2], blocks[::2], blocks[1::2], strict=True):
        assert result.sum_D.tobytes() == (first + second).tobytes()


def test_neighbouring_chunks_around_a_centre_are_one_call_of_the_kernel(monkeypatch):
    """With simd only: xla's bits may depend on the shape."""
    lanes, run = [], EpisodeKernel.run
    monkeypatch.setattr(
        EpisodeKernel, "run", lambda self, *arguments: lanes.append(len(arguments[-1])) or run(self, *arguments)
    )
    make_worker(spec(rollout="simd", episode_steps=5))(work())
    assert lanes == [3 * 16, 2 * 16, 16, 2 * 16, 2 * 16]


def test_simd_runs_only_the_evaluation_episodes_that_are_wanted(monkeypatch):
    wanted, run = [], EpisodeKernel.run
    monkeypatch.setattr(
        EpisodeKernel, "run", lambda self, *arguments: wanted.append(arguments[-1]) or run(self, *arguments)
    )
    point = centre(random_parameters(1))
    chunks = [EvaluationChunk(1, 0), EvaluationChunk(1, 1, episodes=3)]
    make_worker(spec(rollout="simd", episode_steps=5))([(point, chunk) for chunk in chunks])
    assert [one.tolist() for one in wanted] == [[True] * 19 + [False] * 13]


def test_centres_that_take_turns_are_packed_once(monkeypatch):
    kernels = rollout._Kernels(rollout.make_environment("point_maze", {}), spec(), training=True)
    points = [random_parameters(seed) for seed in range(rollout.KEPT_PACKED)]
    mean_O = np.zeros(2, np.float32)
    packed = [kernels.for_centre(point, mean_O)[1] for point in points]
    assert all(kernels.for_centre(point, mean_O)[1] is weights for point, weights in zip(points, packed, strict=True))
    kernels.for_centre(random_parameters(99), mean_O)
    again = kernels.for_centre(points[0], mean_O)[1]
    assert again is not packed[0]


def test_an_exception_names_the_chunk_that_raised_it():
    point = centre(random_parameters(1))
    chunks = [TrainingChunk(3, 0), TrainingChunk(3, 4), TrainingChunk(3, "two"), TrainingChunk(3, 5)]
    with pytest.raises(TypeError) as raised:
        make_worker(spec(rollout="simd"))([(point, chunk) for chunk in chunks])
    assert raised.value.__notes__ == ["raised in TrainingChunk two of generation 3"]
