"""What is not compiled, or not again: each is refused beforehand, with the reason."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import workers.simd.episodes.program
from es_service.protocol.messages import EvaluationChunk, PolicySpec, TrainingChunk
from es_service.protocol.noise import Domain, normal_integers, stream_keys
from tests.helpers import centre, chunk_runner, random_parameters, spec
from workers.environments import SHIPPED, describe_environment, make_environment
from workers.simd.backend import emit
from workers.simd.episodes import check, noise_kernels, rollout
from workers.simd.episodes.compiled import compile_episodes
from workers.simd.frontend.primitives.indexing import MOST_CHOICES
from workers.simd.frontend.tracer import PRIMITIVES
from workers.simd.graph.graph import UnsupportedError


def test_another_generator_is_not_what_was_compiled(monkeypatch: pytest.MonkeyPatch):
    """Kernels are kept on disk; the noise's definition stands outside of the compiler's own files."""
    weights_P, keys_P = np.ones(1, np.float32), stream_keys(1, Domain.PARAMETER_NOISE, 2, np.arange(1))
    before = rollout.make_gradient_sum(50)(weights_P, keys_P)
    for module in (noise_kernels, check):
        monkeypatch.setattr(module, "normal_integers", lambda xp, key, at: 3 * normal_integers(xp, key, at))
    np.testing.assert_allclose(rollout.make_gradient_sum(50)(weights_P, keys_P), 3 * before, rtol=1e-6)


def test_a_step_that_makes_other_arrays_than_a_reset_is_refused():
    wider = dataclasses.replace(
        make_environment("point_maze", {}),
        observe=lambda state: state[:2],
        descriptor=lambda state: state[:2],
        step=lambda state, action: (jnp.zeros(3), jnp.float32(0.0), jnp.array(False)),
    )
    with pytest.raises(TypeError, match=r"step returns a state of arrays .*, but reset one of"):
        compile_episodes(wider, spec(), np.arange(2), training=True)


def test_why_a_task_cannot_have_it():
    assert rollout.why_not(SHIPPED["point_maze"]) == ""
    assert "the primitive fft (at " in rollout.why_not(describe_environment("tests.examples.fourier:Fourier"))


TABLE = jnp.sin(jnp.arange(2.0 * MOST_CHOICES + 2.0)).reshape(-1, 2)
"""One row more than indices that depend on data may choose from."""


class Walk:
    """a point walks by what a function makes of (state, action)"""

    observation_size, action_size, episode_steps = 2, 4, 5
    descriptor_names, descriptor_bounds = ("x", "y"), ((-1.0, 1.0),) * 2
    move: Any = staticmethod(lambda state, action: state["x"])

    def reset(self, key: Any) -> Any:
        return {"x": jnp.zeros(2), "key": key, "count": jnp.uint32(0)}

    def observe(self, state: Any) -> Any:
        return state["x"]

    def step(self, state: Any, action: Any) -> tuple[Any, Any, Any]:
        return {**state, "x": self.move(state, action), "count": state["count"] + 1}, state["x"][0], False

    def descriptor(self, state: Any) -> Any:
        return state["x"]


def _chosen(array: Any, index: Any) -> Any:
    return jax.nn.one_hot(index, len(array)) @ array


def _replaced(array: Any, index: Any) -> Any:
    return jnp.where(jnp.arange(len(array)) == index, 5.0, array)


def _index(state: Any) -> Any:
    return (400.0 * state["x"][0]).astype(jnp.int32)


def _many(state: Any) -> Any:
    return jnp.sin(1000.0 * state["x"][0] + jnp.arange(1000.0))


def _system(state: Any) -> Any:
    return jnp.array([[2.0, 0.0], [0.0, 3.0]]) + state["x"][1]


@pytest.mark.parametrize(
    ("move", "advice", "instead"),
    [
        (
            lambda s, a: TABLE[_index(s)],
            "jax.nn.one_hot(index, len(array)) @ array",
            lambda s, a: _chosen(TABLE, _index(s)),
        ),
        (
            lambda s, a: TABLE[:, 0].at[_index(s)].set(5.0)[99:101],
            "jnp.where(jnp.arange(len(array)) == index, x, array)",
            lambda s, a: _replaced(TABLE[:, 0], _index(s))[99:101],
        ),
        (
            lambda s, a: jnp.sort(_many(s))[::999],
            "the least and the greatest are jnp.min and jnp.max",
            lambda s, a: jnp.stack([_many(s).min(), _many(s).max()]),
        ),
        (
            lambda s, a: jnp.linalg.solve(_system(s), a[:2]),
            "factor positive definite matrices by jnp.linalg.cholesky",
            lambda s, a: jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(_system(s)), a[:2]),
        ),
    ],
)
def test_a_refusal_says_what_the_task_can_do_instead_and_then_it_is_compiled(
    move: Any, advice: str, instead: Any, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(Walk, "move", staticmethod(move))
    why = rollout.why_not(describe_environment(f"{__name__}:Walk"))
    assert "test_refusals.py:" in why
    assert advice in why.partition("; ")[2]
    monkeypatch.setattr(Walk, "move", staticmethod(instead))
    assert rollout.why_not(describe_environment(f"{__name__}:Walk")) == ""
    state = Walk().reset(jnp.zeros(4, jnp.uint32)) | {"x": jnp.array([0.25, -0.5])}
    action = jnp.array([0.1, 0.7, -0.3, 0.2])
    np.testing.assert_allclose(instead(state, action), move(state, action), rtol=1e-6)


def test_keys_of_another_generator_than_threefry_are_refused_with_what_to_use_instead(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(
        Walk, "move", lambda self, state, action: jax.random.uniform(jax.random.key(1, impl="rbg"), (2,)) + action[:2]
    )
    why = rollout.why_not(describe_environment(f"{__name__}:Walk"))
    assert why.startswith("values of type key<rbg>: simd supports float32, integers of 8, 16 and 32 bits, bool and ")
    assert "; draw by JAX's own generator, threefry2x32, or by es_service.protocol.noise.uniforms" in why


class Heat:
    """a plate is heated, and its heat spreads: the loop carries more than fits on a stack"""

    observation_size, action_size, episode_steps = 1, 1, 5
    descriptor_names, descriptor_bounds = ("corner",), ((0.0, 1.0),)
    size = 96

    def reset(self, key: Any) -> Any:
        return jnp.zeros((self.size, self.size))

    def observe(self, state: Any) -> Any:
        return state[0, :1]

    def step(self, state: Any, action: Any) -> tuple[Any, Any, Any]:
        state = jax.lax.fori_loop(0, 50, lambda _, at: 0.9 * at + 0.1 * jnp.roll(at, 1, 0), state) + action[0]
        return state, state[0, 0], False

    def descriptor(self, state: Any) -> Any:
        return state[0, :1]


@pytest.mark.parametrize(
    ("size", "limit", "found"), [(12, 100, "144"), pytest.param(136, 16384, "18,496", marks=pytest.mark.long)]
)
def test_what_the_compiler_refuses_after_tracing_is_refused_beforehand(
    size: int, limit: int, found: str, monkeypatch: pytest.MonkeyPatch
):
    """With a limit that a small plate exceeds, and with that of the compiler."""
    monkeypatch.setattr(Heat, "size", size)
    if size < 136:
        monkeypatch.setattr(emit, "MOST_SLOTS", limit)
    task = describe_environment(f"{__name__}:Heat")
    why = rollout.why_not(task)
    assert why == f"loops carry and read {found} values; simd supports at most {limit:,}"
    worker = chunk_runner(spec(environment=task.name, policy=PolicySpec((1, 8, 1)), episode_steps=5, rollout="simd"))
    point = centre(random_parameters(size=25), observation_size=1)
    for chunk in (TrainingChunk(1, 0), EvaluationChunk(1, 0)):
        with pytest.raises(UnsupportedError, match=why):
            worker(point, chunk)


class Plate(Heat):
    """a plate whose heat spreads once in a step: all of its new values are kept until all old ones have been read"""

    size = 130

    def step(self, state: Any, action: Any) -> tuple[Any, Any, Any]:
        state = 0.9 * state + 0.1 * jnp.roll(state, 1, 0) + action[0]
        return state, state[0, 0], False


class SmallPlate(Plate):
    """a plate that fits"""

    size = 10


@pytest.mark.parametrize(
    ("size", "limit", "found"), [(20, 256, "425"), pytest.param(130, 16384, "17,035", marks=pytest.mark.long)]
)
def test_a_function_that_needs_more_values_at_a_time_than_the_stack_holds_is_refused(
    size: int, limit: int, found: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(Plate, "size", size)
    if size < 130:
        monkeypatch.setattr(emit, "MOST_LIVE", limit)
    why = rollout.why_not(describe_environment(f"{__name__}:Plate"))
    assert why == f"{found} values are needed at the same time; simd supports at most {limit:,}"
    assert rollout.why_not(describe_environment(f"{__name__}:SmallPlate")) == ""


def test_a_step_without_a_text_of_its_own_is_refused_beforehand(monkeypatch: pytest.MonkeyPatch):
    """Kernels are kept under what they compute, so what has no such name is not compiled either."""

    def nameless(*_: Any) -> str:
        raise ValueError("<function at 0x7f>")

    monkeypatch.setattr(workers.simd.episodes.program, "jaxpr_digest", nameless)
    why = rollout.why_not(SHIPPED["point_maze"])
    assert why == "a fault of es-service's compiler, please report it (ValueError: <function at 0x7f>)"


def test_a_fault_of_the_compiler_asks_for_a_report_and_an_unsupported_task_does_not(monkeypatch: pytest.MonkeyPatch):
    def broken(*_: Any) -> Any:
        raise KeyError("add")

    assert "report" not in rollout.why_not(describe_environment("tests.examples.fourier:Fourier"))
    monkeypatch.setitem(PRIMITIVES, "add", broken)
    why = rollout.why_not(SHIPPED["point_maze"])
    assert why.startswith("a fault of es-service's compiler, please report it (KeyError: 'add')")
