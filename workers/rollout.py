"""Compiled batched episodes: a block of policies steps together until all are done, in constant memory.

Nothing is stacked over time. A loop carries, per episode, the state and what will be reported of it; a finished episode
rides along masked, so steps after `done` never count. Shapes are constants of the run: XLA may give other bits for
another batch shape.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from es_service.noise import NORMAL_STD, normal_integers
from es_service.protocol import SIGNS, TRACE_POINTS, WorkerSpec
from workers.environments import Environment
from workers.policy import Layers, act, normalise, split_layers


class Episodes(NamedTuple):
    """What is left of a batch of episodes; leading axes as the caller's."""

    fitness: Any
    returns: Any
    descriptor: Any
    steps: Any
    goal_distance: Any
    """[..., 2]: at the end and at its least."""
    shifted_sum_O: Any
    """Sum over counted steps of (observation - statistics' mean); float32, exact enough for one episode."""
    shifted_square_sum_O: Any
    trace_T_B: Any
    """Of evaluations: descriptors along the first episode; nothing in training."""


class _Carry(NamedTuple):
    step: Any
    state: Any
    alive: Any
    last_reward: Any
    episodes: Episodes


def make_training_rollout(environment: Environment, spec: WorkerSpec) -> Callable[..., Episodes]:
    """Compile-once rollout of one training chunk.

    Returns:
        f(centre_D, unit, mean_O, std_O, noise_keys_P_4, reset_keys_P_S_E_4, action_keys_P_S_E_4) -> Episodes with
        leading axes [P, S]; `unit` is sigma / NORMAL_STD. Pairs step in blocks of `rollout_block_pairs`, one block
        after the other, so that a block's weights stay in cache.
    """
    episodes = _make_member_episodes(environment, spec, training=True)
    block_pairs = spec.rollout_block_pairs
    coordinates_D = np.arange(spec.policy.parameters, dtype=np.uint32)
    signs_S = np.asarray(SIGNS, np.float32)

    def rollout(centre_D, unit, mean_O, std_O, noise_keys_P, reset_keys_P_S_E, action_keys_P_S_E):
        def block(keys):
            noise_keys_P, reset_keys_P_S_E, action_keys_P_S_E = keys
            noise_P_D = jax.vmap(lambda key: normal_integers(jnp, key, coordinates_D))(noise_keys_P)
            offset_P_D = unit * noise_P_D.astype(jnp.float32)
            parameters_P_S_D = centre_D + signs_S[None, :, None] * offset_P_D[:, None, :]
            result_PS = episodes(
                parameters_P_S_D.reshape(2 * block_pairs, -1),
                mean_O,
                std_O,
                *(keys.reshape(2 * block_pairs, *keys.shape[2:]) for keys in (reset_keys_P_S_E, action_keys_P_S_E)),
            )
            return jax.tree.map(lambda x: x.reshape(block_pairs, 2, *x.shape[1:]), result_PS)

        blocks = spec.chunk_pairs // block_pairs
        keys = (noise_keys_P, reset_keys_P_S_E, action_keys_P_S_E)
        by_block = jax.tree.map(lambda x: x.reshape(blocks, block_pairs, *x.shape[1:]), keys)
        return jax.tree.map(lambda x: x.reshape(spec.chunk_pairs, *x.shape[2:]), lax.map(block, by_block))

    return jax.jit(rollout)


def make_evaluation_rollout(environment: Environment, spec: WorkerSpec) -> Callable[..., Episodes]:
    """Compile-once rollout of one evaluation chunk: episodes of one policy, without action noise.

    Returns:
        f(centre_D, mean_O, std_O, reset_keys_E_4) -> Episodes with leading axis [E], but for the trace.
    """
    return jax.jit(_make_episodes(environment, spec, training=False))


def _make_member_episodes(environment: Environment, spec: WorkerSpec, *, training: bool):
    """f(parameters_M_D, mean_O, std_O, reset_keys_M_E_4, action_keys_M_E_4): a member's episodes, one after another.

    Fitness, return, descriptor and goal distance are means over E, least distances minima, steps and sums totals.
    """
    one_each = _make_episodes(environment, spec, training=training)

    def episodes(parameters_M_D, mean_O, std_O, reset_keys_M_E, action_keys_M_E):
        by_episode = (jnp.swapaxes(reset_keys_M_E, 0, 1), jnp.swapaxes(action_keys_M_E, 0, 1))
        all_E_M = lax.map(lambda keys: one_each(parameters_M_D, mean_O, std_O, *keys), by_episode)
        end_M, least_M = all_E_M.goal_distance[..., 0].mean(0), all_E_M.goal_distance[..., 1].min(0)
        return Episodes(
            fitness=all_E_M.fitness.mean(0),
            returns=all_E_M.returns.mean(0),
            descriptor=all_E_M.descriptor.mean(0),
            steps=all_E_M.steps.sum(0),
            goal_distance=jnp.stack([end_M, least_M], axis=-1),
            shifted_sum_O=all_E_M.shifted_sum_O.sum(0),
            shifted_square_sum_O=all_E_M.shifted_square_sum_O.sum(0),
            trace_T_B=None,
        )

    return episodes


def _make_episodes(environment: Environment, spec: WorkerSpec, *, training: bool):
    """One episode per lane: f(parameters, mean_O, std_O, reset_keys_L_4[, action_keys_L_4]) -> Episodes [L].

    In training every lane has its own parameters [L, D] and action noise; otherwise all share parameters [D].
    """
    action_unit = np.float32(spec.action_noise / NORMAL_STD)
    action_size = spec.policy.widths[-1]
    noisy = training and spec.action_noise > 0.0

    def policy(layers: Layers, observation_O, mean_O, std_O):
        return act(jnp, layers, normalise(jnp, observation_O, mean_O, std_O, spec.observation_clip))

    def action_noise(key, step):
        coordinates = step.astype(jnp.uint32) * np.uint32(action_size) + jnp.arange(action_size, dtype=jnp.uint32)
        return action_unit * normal_integers(jnp, key, coordinates).astype(jnp.float32)

    def split(parameters_D):
        return split_layers(spec.policy, parameters_D)

    points = min(TRACE_POINTS, spec.episode_steps + 1)
    places = np.arange(points)

    def traced(trace_T_B, carry: _Carry, state):
        """Point k is where the first episode was after k / (points - 1) of its steps; all later ones are there for now,
        so that an episode that ends early stays where it ended."""
        first_B = environment.descriptor(jax.tree.map(lambda x: x[0], state))
        # ceil((step + 1) * (points - 1) / episode_steps), in integers
        place = ((carry.step + 1) * (points - 1) + spec.episode_steps - 1) // spec.episode_steps
        return jnp.where(((places >= place) & carry.alive[0])[:, None], first_B, trace_T_B)

    policies = jax.vmap(policy, in_axes=(0 if training else None, 0, None, None))

    def episodes(parameters, mean_O, std_O, reset_keys_L, action_keys_L=None):
        lanes = reset_keys_L.shape[0]
        layers = jax.vmap(split)(parameters) if training else split(parameters)  # once: inside the loop it is a copy

        def body(carry: _Carry) -> _Carry:
            alive, so_far = carry.alive, carry.episodes
            observation_L_O = jax.vmap(environment.observe)(carry.state)
            action_L_A = policies(layers, observation_L_O, mean_O, std_O)
            if noisy:
                action_L_A += jax.vmap(action_noise, in_axes=(0, None))(action_keys_L, carry.step)
            state, reward_L, done_L = jax.vmap(environment.step)(carry.state, action_L_A)
            distance_L = jax.vmap(environment.goal_distance)(state)
            least_L = jnp.fmin(so_far.goal_distance[:, 1], distance_L)
            if training:
                shifted_L_O = jnp.where(alive[:, None], observation_L_O - mean_O, 0.0)
            else:
                shifted_L_O = jnp.zeros((lanes, 1), jnp.float32)  # evaluations feed no statistics
            last_reward_L = jnp.where(alive, reward_L, carry.last_reward)
            returns_L = so_far.returns + jnp.where(alive, reward_L, 0.0)
            now = Episodes(
                fitness=last_reward_L if spec.fitness == "final" else returns_L,
                returns=returns_L,
                descriptor=jnp.where(alive[:, None], jax.vmap(environment.descriptor)(state), so_far.descriptor),
                steps=so_far.steps + alive.astype(jnp.int32),
                goal_distance=jnp.where(alive[:, None], jnp.stack([distance_L, least_L], -1), so_far.goal_distance),
                shifted_sum_O=so_far.shifted_sum_O + shifted_L_O,
                shifted_square_sum_O=so_far.shifted_square_sum_O + shifted_L_O * shifted_L_O,
                trace_T_B=None if training else traced(so_far.trace_T_B, carry, state),
            )
            return _Carry(carry.step + 1, state, alive & ~done_L, last_reward_L, now)

        def unfinished(carry: _Carry):
            return (carry.step < spec.episode_steps) & carry.alive.any()

        state = jax.vmap(environment.reset)(reset_keys_L)
        start_L_B = jax.vmap(environment.descriptor)(state)
        zero_L = jnp.zeros(lanes, jnp.float32)
        sums = jnp.zeros((lanes, mean_O.shape[0] if training else 1), jnp.float32)
        nothing = Episodes(
            fitness=zero_L,
            returns=zero_L,
            descriptor=jnp.zeros_like(start_L_B),
            steps=jnp.zeros(lanes, jnp.int32),
            goal_distance=jnp.full((lanes, 2), jnp.nan, jnp.float32),
            shifted_sum_O=sums,
            shifted_square_sum_O=sums,
            trace_T_B=None if training else jnp.broadcast_to(start_L_B[0], (points, start_L_B.shape[-1])),
        )
        start = _Carry(jnp.int32(0), state, jnp.ones(lanes, bool), zero_L, nothing)
        return lax.while_loop(unfinished, body, start).episodes

    return episodes
