"""Code shared by rollouts of JAX tasks: recording an episode that was watched, and steps with random actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from es_service.protocol.messages import TaskSpec, WorkerSpec
from es_service.protocol.noise import NORMAL_STD, Domain, normal_integers, stream_keys
from es_service.protocol.options import OptionValue
from es_service.protocol.recordings import Recording, Recordings, RecordRequest
from workers import environments
from workers.viewer import shapes


def record(
    make_watched_rollout: Callable[..., Callable[..., Any]], spec: WorkerSpec, requests: Sequence[RecordRequest]
) -> Recordings:
    """Record the requested episodes with a rollout's own loop, so that they have the bits of the run's own.

    Args:
        make_watched_rollout: as `workers.rollout.make_watched_rollout`.
    """
    environment = environments.make_environment(spec.environment, spec.environment_options)
    watched = {own: make_watched_rollout(environment, spec, per_lane_weights=own) for own in (False, True)}
    viewer = environment.viewer
    recordings = tuple(_record(environment, watched, request) for request in requests)
    return Recordings(
        recordings, shapes(viewer.model) if viewer is not None else (), viewer.step_s if viewer is not None else 0.0
    )


def _record(
    environment: environments.Environment, watched: Mapping[bool, Callable[..., Any]], request: RecordRequest
) -> Recording:
    centre = request.centre
    key = request.reset_key
    carry_T = watched[request.policy is not None](
        centre.parameters_D, centre.observation_mean_O, centre.observation_std_O, key, request.slot
    )
    end = int(np.asarray(carry_T.episode.steps).max()) + 1
    carry_T = jax.tree.map(lambda leaf: np.asarray(leaf)[:end], carry_T)
    poses = None
    if environment.viewer is not None:
        x = jax.jit(jax.vmap(environment.viewer.poses))(carry_T.state)
        poses = np.concatenate([np.asarray(x.pos), np.asarray(x.rot)], axis=-1)
    descriptor = jax.jit(jax.vmap(lambda state: jnp.asarray(environment.descriptor(state), jnp.float32)))
    return Recording(
        descriptor_T_B=np.asarray(descriptor(carry_T.state)),
        returns_T=carry_T.episode.returns,
        poses_T_L_7=poses,
        fitness=float(carry_T.episode.fitness[-1]),
        trace_T_B=carry_T.episode.trace_T_B[-1],
    )


def random_steps(
    compiled: Callable[..., Callable[..., Any]],
    task: TaskSpec,
    options: Mapping[str, OptionValue],
    batch: int,
    steps: int,
) -> Callable[[int], int]:
    """See `RolloutBackend.random_steps`.

    Args:
        compiled: function (episode, key, state) -> episodes; `episode` is a function of one lane, `key` and `state` are
            the shapes of its arguments, and `episodes` has batches of them.
    """
    environment = environments.make_environment(task.name, options)
    coordinates_A = jnp.arange(task.action_size, dtype=jnp.uint32)
    states = jax.jit(jax.vmap(environment.reset))(stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(batch)))

    def episode(key: Any, state: Any) -> Any:
        def step(number: Any, carry: tuple[Any, Any]) -> tuple[Any, Any]:
            state, total = carry
            noise_A = normal_integers(jnp, key, number.astype(jnp.uint32) * 1024 + coordinates_A)
            state, reward, _ = environment.step(state, jnp.clip(noise_A.astype(jnp.float32) / NORMAL_STD, -1.0, 1.0))
            return state, total + reward + environment.observe(state).sum()

        return lax.fori_loop(0, steps, step, (state, jnp.float32(0.0)))[1]

    one_state = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), states)
    episodes = compiled(episode, jax.ShapeDtypeStruct((4,), jnp.uint32), one_state)

    def call(number: int) -> int:
        jax.block_until_ready(episodes(stream_keys(0, Domain.TRAINING_RESET, number, np.arange(batch)), states))
        return batch * steps

    return call
