"""Tasks of which simd cannot compile something."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from es_service.protocol.noise import uniforms


class _State(NamedTuple):
    place: Any
    key: Any
    counter: Any
    is_high: Any


class Drawn:
    """the step has Fourier transforms, and the state arrays of several sizes and a key of JAX that draws noise; the
    episode ends at random"""

    observation_size, action_size, episode_steps = 3, 3, 20
    descriptor_names, descriptor_bounds = ("x", "y"), ((-2.0, 2.0), (-2.0, 2.0))

    def reset(self, key: Any) -> _State:
        place = 2.0 * uniforms(key, jnp.arange(3, dtype=jnp.uint32)) - 1.0
        return _State(place, jax.random.wrap_key_data(key[:2]), jnp.zeros(2, jnp.uint8), jnp.array(False))

    def observe(self, state: _State) -> Any:
        return state.place

    def step(self, state: _State, action: Any) -> tuple[_State, Any, Any]:
        key, mine = jax.random.split(state.key)
        moved = there_and_back(state.place + 0.1 * action + 0.1 * jax.random.normal(mine, (3,)))
        place = jnp.clip(jnp.sort(moved), -2.0, 2.0)
        after = _State(place, key, state.counter + jnp.uint8(100), place[2] > 1.0)
        return after, place[0] + state.counter.astype(jnp.float32).sum(), jax.random.bernoulli(key, 0.1)

    def descriptor(self, state: _State) -> Any:
        return state.place[:2]


def there_and_back(numbers: Any) -> Any:
    """The numbers, after a Fourier transform and its inverse."""
    return jnp.fft.irfft(jnp.fft.rfft(numbers), len(numbers))


class TransformedStart:
    """only the reset has Fourier transforms"""

    observation_size, action_size, episode_steps = 3, 3, 20
    descriptor_names, descriptor_bounds = ("x", "y"), ((-2.0, 2.0), (-2.0, 2.0))

    def reset(self, key: Any) -> Any:
        return there_and_back(uniforms(key, jnp.arange(3, dtype=jnp.uint32)))

    def observe(self, state: Any) -> Any:
        return state

    def step(self, state: Any, action: Any) -> tuple[Any, Any, Any]:
        return state + 0.1 * action, state[0], state[0] > 1.1

    def descriptor(self, state: Any) -> Any:
        return state[:2]


class SometimesTransformed(TransformedStart):
    """the step has Fourier transforms if an option says so"""

    options = {"transforms": (False, True)}  # noqa: RUF012

    def __init__(self, transforms: bool = False) -> None:
        self.transforms = transforms

    def step(self, state: Any, action: Any) -> tuple[Any, Any, Any]:
        state = state + 0.1 * action
        return there_and_back(state) if self.transforms else state, state[0], state[0] > 1.1


class Raising(TransformedStart):
    """the step has Fourier transforms, and raises when it is traced for a batch"""

    def step(self, state: Any, action: Any) -> tuple[Any, Any, Any]:
        state = there_and_back(state + action)
        return jax.pure_callback(_raise, state, state, vmap_method="expand_dims"), state[0], jnp.array(False)


def _raise(state: Any) -> Any:
    if state.ndim > 1:
        raise ValueError("the sixteenth time is too often")
    return state
