"""Resets that this compiler cannot do are JAX's, whatever is wrong with them; steps are compiled all the same."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from es_service.protocol.messages import EvaluationChunk, PolicySpec, TrainingChunk
from es_service.protocol.noise import Domain, stream_keys
from tests.helpers import centre, chunk_runner, random_parameters, spec
from workers.environments import describe_environment, make_environment
from workers.simd.backend.native import unpack
from workers.simd.backend.target import host_target
from workers.simd.episodes import rollout
from workers.simd.episodes.kernel import compile_kernel, compile_resets
from workers.simd.frontend.tracer import PRIMITIVES
from workers.simd.graph.graph import UnsupportedError


class Drift:
    """a point is pushed about"""

    observation_size, action_size, episode_steps = 2, 2, 10
    descriptor_names, descriptor_bounds = ("x", "y"), ((-9.0, 9.0), (-9.0, 9.0))

    def reset(self, key: Any) -> Any:
        return jnp.array([0.5, -0.5]) + 1e-9 * key[:2].astype(jnp.float32)

    def observe(self, state: Any) -> Any:
        return state

    def step(self, state: Any, action: Any) -> tuple[Any, Any, Any]:
        state = state + 0.1 * jnp.clip(action, -1.0, 1.0)
        return state, -jnp.abs(state).sum(), False

    def descriptor(self, state: Any) -> Any:
        return state


class Keyed(Drift):
    """a key of JAX's own kind is a constant of its reset"""

    def __init__(self) -> None:
        self.layout = jax.random.key(7)

    def reset(self, key: Any) -> Any:
        return super().reset(key) + jax.random.uniform(self.layout, (2,))


class Drawing(Drift):
    """its state has a key of JAX, with which its steps draw"""

    def reset(self, key: Any) -> Any:
        return super().reset(key), jax.random.wrap_key_data(key[:2]), jnp.int8(100)

    def observe(self, state: Any) -> Any:
        return state[0]

    def step(self, state: Any, action: Any) -> tuple[Any, Any, Any]:
        place, key, count = state
        key, here = jax.random.split(key)
        place, reward, _ = super().step(place + 0.1 * jax.random.normal(here, (2,)), action)
        return (place, key, count + jnp.int8(50)), reward + count, jax.random.bernoulli(key, 0.05)

    def descriptor(self, state: Any) -> Any:
        return state[0]


class Watched(Drift):
    """its reset calls Python, by an address that no other process has"""

    def reset(self, key: Any) -> Any:
        state = super().reset(key)
        jax.debug.callback(lambda at: None, state)
        return state


@pytest.mark.slow
@pytest.mark.parametrize("task", [Drift, Keyed, Watched, Drawing])
def test_a_reset_that_the_compiler_chokes_on_is_jaxs_and_steps_may_draw_by_jax(task: type) -> None:
    name = f"{__name__}:{task.__name__}"
    assert rollout.why_not(describe_environment(name)) == ""
    worker_spec = spec(environment=name, policy=PolicySpec((2, 8, 2)), episode_steps=10)
    simd, xla = (
        chunk_runner(spec(**vars(worker_spec) | {"rollout": rollout_name})) for rollout_name in ("simd", "xla")
    )
    point = centre(random_parameters(size=worker_spec.policy.parameters))
    for chunk in (TrainingChunk(1, 0), EvaluationChunk(1, 0)):
        ours, theirs = simd(point, chunk), xla(point, chunk)
        np.testing.assert_allclose(ours.returns, theirs.returns, rtol=1e-4)
        np.testing.assert_allclose(ours.descriptor, theirs.descriptor, atol=1e-4)


@pytest.mark.parametrize("may_draw", [False, True])
def test_a_reset_that_draws_is_compiled_only_if_its_task_says_so(may_draw: bool) -> None:
    """JAX's normal numbers and simd's differ in a few bits of a thousand, and runs of older versions have JAX's."""
    keys_L = stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(4000))
    draw = lambda key: jax.random.normal(key[:2], (50,))  # noqa: E731
    resets = compile_resets(draw, host_target(), None, 4000, may_draw=may_draw)
    words = unpack(resets(keys_L), [jax.ShapeDtypeStruct((50,), jnp.float32)], 4000)[0]
    of_jax = np.asarray(jax.jit(jax.vmap(draw))(keys_L))
    assert (words != of_jax).any() == may_draw
    np.testing.assert_allclose(words, of_jax, rtol=3e-7)


def test_what_a_rule_did_not_foresee_is_refused_by_name_and_place(monkeypatch: pytest.MonkeyPatch) -> None:
    def rule(*_: Any) -> Any:
        raise KeyError("axis")

    monkeypatch.setitem(PRIMITIVES, "sin", rule)
    with pytest.raises(UnsupportedError, match=r"KeyError: 'axis'\) \(at .*test_resets\.py"):
        compile_kernel(lambda x: jnp.sin(x) + 1.0, jax.ShapeDtypeStruct((), jnp.float32))


@pytest.mark.slow
def test_resets_of_jax_do_not_depend_on_how_many_chunks_are_computed_together() -> None:
    """XLA rounds the resets of this ant in other ways for 240 of them than for 60."""
    pairs = 30
    environment = make_environment("brax:ant", {})
    resets = compile_resets(environment.reset, host_target(), None, 2 * pairs)
    keys_L = stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(8 * pairs))
    leaves = jax.tree.leaves(jax.eval_shape(environment.reset, keys_L[0]))
    together = unpack(resets(keys_L), leaves, len(keys_L))
    alone = [unpack(resets(keys_M), leaves, len(keys_M)) for keys_M in np.split(keys_L, 4)]
    for leaf, *parts in zip(together, *alone, strict=True):
        np.testing.assert_array_equal(leaf, np.concatenate(parts))
