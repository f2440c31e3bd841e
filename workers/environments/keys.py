"""Keys of JAX in the state of a task: rollouts see the words of which they consist."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from workers.environments import Environment


@partial(jax.tree_util.register_dataclass, data_fields=["words"], meta_fields=["kind"])
@dataclasses.dataclass(frozen=True)
class KeyWords:
    """The words of keys of JAX, in their place in a state."""

    words: Any
    """uint32 [..., words of a key]."""
    kind: str
    """JAX's name of the generator."""


def words_in_place_of_keys(environment: Environment) -> Environment:
    """The environment with `KeyWords` in its states where its own functions have typed keys of JAX."""

    def outside(state: Any) -> Any:
        return jax.tree.map(lambda leaf: _words(leaf) if _is_key(leaf) else leaf, state)

    def inside(state: Any) -> Any:
        return jax.tree.map(_key, state, is_leaf=lambda leaf: isinstance(leaf, KeyWords))

    def step(state: Any, action: Any) -> tuple[Any, Any, Any]:
        after, reward, done = environment.step(inside(state), action)
        return outside(after), reward, done

    viewer = environment.viewer
    return dataclasses.replace(
        environment,
        reset=lambda key: outside(environment.reset(key)),
        observe=lambda state: environment.observe(inside(state)),
        step=step,
        descriptor=lambda state: environment.descriptor(inside(state)),
        goal_distance=lambda state: environment.goal_distance(inside(state)),
        success=lambda state, before: environment.success(inside(state), before),
        metrics=None if (metrics := environment.metrics) is None else lambda state: metrics(inside(state)),
        viewer=viewer and viewer._replace(poses=lambda state: viewer.poses(inside(state))),
    )


def _is_key(leaf: Any) -> bool:
    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _words(keys: Any) -> KeyWords:
    return KeyWords(jax.random.key_data(keys), str(jax.random.key_impl(keys)))


def _key(leaf: Any) -> Any:
    return jax.random.wrap_key_data(leaf.words, impl=leaf.kind) if isinstance(leaf, KeyWords) else leaf
