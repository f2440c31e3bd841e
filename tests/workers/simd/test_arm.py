"""64-bit Arm gives the bits of x86-64: primitives, whole episodes, and a run's digest, by code that qemu runs.

Primitives are compared at every width of x86-64 as well. Tests beside this one take targets of Arm, too: operations,
noise, gradients, policies, recipes, steps of each task.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from es_service import api
from es_service.protocol.messages import ChunkResult, PolicySpec, Work, WorkerSpec
from es_service.store.digest import digest_parts
from tests import helpers
from tests.workers.simd.emulated import arm_targets
from tests.workers.simd.primitive_cases import CASES
from tests.workers.simd.rollouts import arguments, every_target, targets, task_spec
from workers.environments import make_environment
from workers.simd.backend.native import require_same
from workers.simd.backend.target import Target
from workers.simd.episodes import compiled, kernel, noise_kernels, rollout
from workers.simd.episodes.compiled import compile_episodes
from workers.simd.episodes.kernel import compile_kernel
from workers.simd.frontend.trace import trace_jaxpr
from workers.simd.graph.schedule import evaluate
from workers.worker import make_worker

GENTLE = settings(
    deadline=None, derandomize=True, database=None, phases=[Phase.generate], suppress_health_check=list(HealthCheck)
)
ON_ARM = pytest.mark.parametrize("target", arm_targets(), ids=lambda target: target.isa)


def same_words(found: Any, wanted: Any, what: str) -> None:
    """Hold the leaves of two results against each other, bit for bit; all NaN count as the same."""
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        one, other = np.asarray(one), np.asarray(other)
        assert (one.dtype, one.shape) == (other.dtype, other.shape)
        if one.dtype == np.float32:
            require_same(one, other, what)
        else:
            np.testing.assert_array_equal(one, other, err_msg=what)


def every_primitive(draw: Any, target: Target) -> None:
    """One kernel of all cases together, for a target, for the widest vectors of this processor and in NumPy."""
    functions, given_ = zip(*(case(draw) for case in CASES.values()), strict=True)

    def function(given_: Any) -> Any:
        return [one(*arguments) for one, arguments in zip(functions, given_, strict=True)]

    lanes = min(len(x) for x in jax.tree.leaves(given_))
    given_ = jax.tree.map(lambda x: np.asarray(x)[:lanes], given_)
    of = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), given_)
    found, wanted = (compile_kernel(function, of, target=one)(given_) for one in (target, targets()[0]))
    for name, one, other in zip(CASES, found, wanted, strict=True):
        same_words(one, other, name)
    graph, _, outputs = trace_jaxpr(jax.make_jaxpr(function)(of))
    reference = evaluate(graph, outputs, as_words(given_))
    require_same(as_words(found), as_words([value[:, None] for value in reference]), "the reference implementation")


def as_words(tree: Any) -> np.ndarray:
    """Words [word, lane] of arrays [lane, ...]; a bool is 0 or 1."""
    rows = [np.asarray(x).reshape(len(x), -1).T for x in jax.tree.leaves(tree)]
    return np.concatenate([x.astype(np.uint32) if x.itemsize < 4 else x.copy().view(np.uint32) for x in rows])


ON_EVERY_TARGET = pytest.mark.parametrize("target", every_target(), ids=lambda target: target.isa)


@pytest.mark.slow
@ON_EVERY_TARGET
@settings(GENTLE, max_examples=2)
@given(data=st.data())
def test_every_primitive_has_the_same_bits_on_every_target_and_in_its_reference(
    data: st.DataObject, target: Target
) -> None:
    every_primitive(data.draw, target)


@pytest.mark.long
@ON_EVERY_TARGET
@settings(GENTLE, max_examples=12)
@given(data=st.data())
def test_so_it_has_for_more_shapes_and_values(data: st.DataObject, target: Target) -> None:
    every_primitive(data.draw, target)


KINDS = pytest.mark.parametrize("kind", ["training", "evaluation", "policies"])


@ON_ARM
@KINDS
@pytest.mark.parametrize("hidden", [(16, 16), pytest.param((64, 64), marks=pytest.mark.long)], ids=str)
def test_whole_episodes_of_point_maze_have_the_bits_of_x86(hidden: tuple, kind: str, target: Target) -> None:
    hold_episodes_against_x86("point_maze", 200, hidden, kind, target)


@pytest.mark.long
@pytest.mark.parametrize("target", arm_targets()[:1], ids=lambda target: target.isa)
@KINDS
@pytest.mark.parametrize(
    ("task", "steps", "hidden"),
    [("ant_trap", 1000, (16, 16)), ("ant_trap", 20, (256, 256)), ("ant_maze", 300, (16, 16))],
)
def test_whole_episodes_of_ants_have_the_bits_of_x86(
    task: str, steps: int, hidden: tuple, kind: str, target: Target
) -> None:
    hold_episodes_against_x86(task, steps, hidden, kind, target)


def hold_episodes_against_x86(task: str, steps: int, hidden: tuple[int, ...], kind: str, target: Target) -> None:
    environment, whole = make_environment(task, {}), task_spec(task)
    shape = PolicySpec((whole.policy.widths[0], *hidden, whole.policy.widths[-1]))
    worker_spec = dataclasses.replace(whole, policy=shape, episode_steps=steps)
    centre_D, unit, mean_O, std_O, keys, resets, actions = arguments(worker_spec, 2.0)
    lanes, training, own = 16, kind == "training", kind == "policies"
    found = []
    for one in (targets()[0], target):
        made = compile_episodes(
            environment, worker_spec, np.arange(len(mean_O)), training=training, per_lane_weights=own, target=one
        )
        weights, mean, std = made.network.pack(centre_D), mean_O, std_O
        if own:
            rng = np.random.default_rng(0)
            kept, weights = made.network.room_for_weights(lanes, shape.parameters)
            kept[...] = centre_D + rng.normal(0, 0.1, kept.shape)
            mean, std = np.tile(mean_O, (lanes, 1)), np.tile(std_O, (lanes, 1))
        of_lanes = (given_.reshape(-1, 4)[:lanes] for given_ in (resets, actions))
        wanted_L = None if training else np.arange(lanes) % 3 > 0
        noise = keys[: lanes // 2] if training else None
        found.append(made.run(weights, float(unit), mean, std, noise, *of_lanes, wanted_L))
        assert not own or len(kept)
    assert len(np.unique(found[0].returns)) > lanes // 2
    same_words(found[1], found[0], task)


CONFIG = {
    "task": {"environment": "point_maze"},
    "policy": {"hidden": [8, 8]},
    "search": {"algorithm": "ns_es", "pairs": 8, "sigma": 0.1, "evaluation_episodes": 4, "centres": 2},
    "novelty": {"neighbours": 3},
    "budget": {"generations": 10},
    "compute": {"engine": "inline", "workers": 1, "rollout": "simd", "chunk_pairs": 4, "gradient_block_pairs": 4},
}


def digest_on(hosts: Sequence[Target], folder: Path) -> dict[str, str]:
    """Parts of the digest of a run whose work items are computed by hosts of several kinds, by turns."""

    def worker_here(worker_spec: WorkerSpec) -> Callable[[Sequence[Work]], list[ChunkResult]]:
        workers = [make_worker(worker_spec) for _ in hosts]

        def run(work: Sequence[Work]) -> list[ChunkResult]:
            found: list[Any] = [None] * len(work)
            for number, (host, worker) in enumerate(zip(hosts, workers, strict=True)):
                with pytest.MonkeyPatch.context() as patch:  # kernels are compiled when they are first needed
                    for module in (compiled, kernel, rollout, noise_kernels):
                        patch.setattr(module, "host_target", lambda host=host: host)
                    found[number :: len(hosts)] = worker(work[number :: len(hosts)])
            return found

        return run

    with helpers.workers_in_this_process(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(helpers, "worker_here", worker_here)
        api.run(api.load_config(CONFIG), out=folder)
    return digest_parts(folder)


@pytest.fixture(scope="module")
def digest(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """That of this processor alone: ten generations of populations, centres and sums of gradients."""
    return digest_on(targets()[:1], tmp_path_factory.mktemp("alone") / "run")


@ON_ARM
def test_a_run_computed_on_arm_has_the_digest_of_x86(target: Target, digest: dict[str, str], tmp_path: Path) -> None:
    assert digest_on([target], tmp_path / "run") == digest


@ON_ARM
def test_hosts_of_both_architectures_in_one_run_give_its_digest(target: Target, digest, tmp_path: Path) -> None:
    assert digest_on([targets()[0], target], tmp_path / "run") == digest


def test_hosts_with_vectors_of_several_widths_in_one_run_give_its_digest(digest, tmp_path: Path) -> None:
    """AVX-512, AVX2 and half vectors, or those of them that this processor has."""
    assert len(targets()) > 1
    assert digest_on(targets(), tmp_path / "run") == digest
