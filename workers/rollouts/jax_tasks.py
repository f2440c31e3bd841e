"""Code shared by rollouts of JAX tasks: which episodes are invalid and why, recordings of episodes that were watched,
and steps with random actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from es_service.protocol.episodes import INFEASIBLE
from es_service.protocol.messages import TaskSpec, WorkerSpec
from es_service.protocol.noise import NORMAL_STD, Domain, normal_integers, stream_keys
from es_service.protocol.options import OptionValue
from es_service.protocol.recordings import Recording, Recordings, RecordRequest
from workers import environments
from workers.compiling import Compilable
from workers.rollouts.backend import (
    BAD_REWARD,
    NO_FAULT,
    ChunkFunctions,
    Episodes,
    FailedEpisode,
    observation_text,
)
from workers.viewer import scene


def judged(functions: ChunkFunctions, spec: WorkerSpec) -> ChunkFunctions:
    """The functions of a run's rollout that finds faults, with episodes that are invalid where the policy acted on an
    observation that is NaN, or infinite and not clipped, and with the names of all that are invalid.
    """

    def function(of: Compilable, reset_keys: int, wanted: int | None = None) -> Compilable:
        """`of`, which has reset keys, and whether lanes are wanted, as arguments with these numbers."""

        def run(*given: Any) -> Episodes:
            episodes = of(*given)
            if episodes.fault is None:
                return episodes
            return _judged(episodes, given[reset_keys], True if wanted is None else given[wanted], spec)

        return Compilable(run, of.compile)

    return functions._replace(
        training=function(functions.training, 5),
        evaluation=function(functions.evaluation, 3, 4),
        policies=function(functions.policies, 4),
    )


def _judged(episodes: Episodes, reset_keys: Any, is_wanted: Any, spec: WorkerSpec) -> Episodes:
    episodes = episodes.map(np.asarray)
    step, number = episodes.fault[..., 0], episodes.fault[..., 1]
    fitness, returns = (
        np.where(number < BAD_REWARD, np.float32(np.nan), x) for x in (episodes.fitness, episodes.returns)
    )
    is_invalid = ~(np.isfinite(fitness) & np.isfinite(episodes.descriptor).all(axis=-1)) & is_wanted
    if spec.allow_infeasible:
        is_invalid &= fitness != -np.inf
    bad_observation = "NaN" if spec.observation_clip is not None else "NaN or infinite"
    failures = []
    for at in map(tuple, np.argwhere(is_invalid)):
        if number[at] < BAD_REWARD:
            why = f"{observation_text(number[at], step[at])} is {bad_observation}"
        elif not np.isfinite(returns[at]):
            last = episodes.steps[at] if number[at] == NO_FAULT else step[at]
            hint = f"; {INFEASIBLE}" if returns[at] == -np.inf else ""
            why = f"the reward of step {last} is NaN or infinite, or the sum of rewards with it{hint}"
        else:
            why = f"its descriptor is {episodes.descriptor[at].tolist()}"
        key = ", ".join(map(str, reset_keys[at]))
        lane = at[0] if len(at) == 1 else at[0] * fitness.shape[1] + at[1]
        failures.append(FailedEpisode(int(lane), f"(key of its reset: {key}): {why}"))
    return episodes._replace(fitness=fitness, returns=returns, fault=None, failures=tuple(failures))


def record(
    make_watched_rollout: Callable[..., Callable[..., Any]], spec: WorkerSpec, requests: Sequence[RecordRequest]
) -> Recordings:
    """Record the requested episodes with a rollout's own loop, so that they have the bits of the run's own.

    Args:
        make_watched_rollout: as `workers.xla.make_watched_rollout`.
    """
    environment = environments.make_environment(spec.environment, spec.environment_options)
    watched = {own: make_watched_rollout(environment, spec, per_lane_weights=own) for own in (False, True)}
    viewer = environment.viewer
    recordings = tuple(_record(environment, watched, request) for request in requests)
    return Recordings(recordings, None if viewer is None else scene(viewer))


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
