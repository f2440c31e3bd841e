"""New machine code is compared with its reference implementation before it is used.

Right code passes; wrong code is found and not kept.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from es_service.protocol.messages import EvaluationChunk, PolicySpec, TrainingChunk
from es_service.protocol.noise import Domain, stream_keys
from tests.helpers import centre, chunk_runner, random_parameters, spec
from tests.workers.simd.rollouts import every_target, targets
from workers.environments import make_environment
from workers.simd.backend.function_builder import FunctionBuilder
from workers.simd.backend.native import WrongCodeError, require_same
from workers.simd.episodes import noise_kernels
from workers.simd.episodes.check import check_episodes, check_resets
from workers.simd.episodes.compiled import EpisodeKernel, compile_episodes
from workers.simd.episodes.kernel import compile_kernel
from workers.simd.episodes.program import EpisodeProgram
from workers.simd.episodes.rollout import make_gradient_sum
from workers.simd.graph.operations import OPERATIONS

KINDS = [{"training": True}, {"training": False}, {"training": False, "per_lane_weights": True}]


@pytest.mark.parametrize("target", every_target(), ids=lambda target: target.isa)
@pytest.mark.parametrize("kind", KINDS, ids=["training", "evaluation", "policies"])
@pytest.mark.parametrize("hidden", [(), (16,), (33, 48), (144,)], ids=str)
def test_policies_of_all_shapes_have_the_bits_of_their_reference(hidden, kind, target, tmp_path: Path) -> None:
    shape = spec(policy=PolicySpec((2, *hidden, 2)))
    checked = []
    compile_episodes(
        make_environment("point_maze", {}),
        shape,
        np.arange(2),
        target=target,
        folder=tmp_path,
        check=lambda kernel, program: checked.append(check_episodes(kernel, program)),
        **kind,
    )
    assert checked == [None]


@pytest.mark.parametrize("target", every_target(), ids=lambda target: target.isa)
@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize(("hidden", "rank"), [((), 2), ((16,), 1), ((33, 48), 3), ((144,), 1)], ids=str)
def test_members_with_noise_of_low_rank_have_the_bits_of_their_reference(
    hidden, rank, bias, target, tmp_path: Path
) -> None:
    shape = spec(policy=PolicySpec((2, *hidden, 2), bias=bias), noise_rank=rank)
    checked = []

    def check(kernel: EpisodeKernel, program: EpisodeProgram) -> None:
        checked.append(check_episodes(kernel, program))
        for wrong in (rank + 1, 0):
            with pytest.raises(WrongCodeError):
                check_episodes(replace(kernel, spec=replace(shape, noise_rank=wrong)), program)

    environment = make_environment("point_maze", {})
    compile_episodes(environment, shape, np.arange(2), training=True, target=target, folder=tmp_path, check=check)
    assert checked == [None]


@pytest.fixture
def worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A worker whose kernels are all new to its machine."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    run = chunk_runner(spec(rollout="simd"))
    return lambda chunk: run(centre(random_parameters()), chunk)


CHUNKS = [TrainingChunk(1, 0), EvaluationChunk(1, 0)]


@pytest.mark.parametrize("chunk", CHUNKS, ids=["training", "evaluation"])
@pytest.mark.parametrize(
    ("operation", "llvm", "what"),
    [("ixor", "or {I} {0}, {1}", "a reset"), ("sqrt", "llvm.fabs.{N}", "a step")],
    ids=["reset", "step"],
)
def test_an_instruction_that_computes_something_else_is_found_and_the_code_is_not_kept(
    worker, chunk, operation, llvm, what, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = OPERATIONS[operation]._replace(llvm=llvm)
    with monkeypatch.context() as broken:
        broken.setitem(OPERATIONS, operation, wrong)
        for _ in range(2):  # so nothing is found in the cache
            message = rf"words of {what} of point_maze differ.*set compute.rollout to xla"
            with pytest.raises(WrongCodeError, match=message):
                worker(chunk)
    worker(chunk)


def test_a_wrong_reset_is_found_before_its_code_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Resets have code of their own, which the episodes of other policies use, too."""
    begin, key = make_environment("point_maze", {}).reset, stream_keys(0, Domain.EVALUATION_RESET, 0, np.arange(1))[0]

    def compiled():
        return compile_kernel(begin, key, folder=tmp_path, check=partial(check_resets, environment="point_maze"))

    with monkeypatch.context() as broken:
        broken.setitem(OPERATIONS, "ixor", OPERATIONS["ixor"]._replace(llvm="or {I} {0}, {1}"))
        with pytest.raises(WrongCodeError, match="words of a reset of point_maze differ"):
            compiled()
    assert not compiled().facts.cached
    assert compiled().facts.cached


@pytest.mark.parametrize("chunk", CHUNKS, ids=["training", "evaluation"])
def test_a_wrong_sum_of_the_policy_is_found(worker, chunk, monkeypatch: pytest.MonkeyPatch) -> None:
    right = FunctionBuilder.fma
    with monkeypatch.context() as broken:
        broken.setattr(FunctionBuilder, "fma", lambda self, a, b, c: right(self, b, c, a))
        with pytest.raises(WrongCodeError, match="report this"):
            worker(chunk)
    worker(chunk)


def test_a_wrong_gradient_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of more parameters than the code computes at a time, or of fewer."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    right = FunctionBuilder.fma
    with monkeypatch.context() as broken:
        broken.setattr(FunctionBuilder, "fma", lambda self, a, b, c: right(self, a, b, "zeroinitializer"))
        with pytest.raises(WrongCodeError, match="words of a gradient differ"):
            make_gradient_sum(50)
    for target in targets():
        make_gradient_sum(1000, target)


def test_noise_of_the_wrong_pair_is_found(worker, monkeypatch: pytest.MonkeyPatch) -> None:
    def of_the_first(builder: FunctionBuilder, keys: str) -> list[str]:
        return noise_kernels.load_key(builder, keys, "0")

    monkeypatch.setattr(noise_kernels, "keys_of_members", of_the_first)
    with pytest.raises(WrongCodeError):
        worker(TrainingChunk(1, 0))


def test_one_wrong_bit_is_a_difference_and_two_nan_are_none() -> None:
    x = np.array([1.0, np.nan, 0.0], np.float32)
    require_same(x, np.array([1.0, -np.nan, 0.0], np.float32), "numbers")
    for other in (np.nextafter(x, np.float32(2.0)), np.array([1.0, np.nan, -0.0], np.float32)):
        with pytest.raises(WrongCodeError, match="of 3 words of numbers differ"):
            require_same(x, other, "numbers")
