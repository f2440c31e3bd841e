"""Batched episodes compiled by XLA: a block of policies steps together until all are done, in constant memory.

Nothing is stacked over time. A loop carries the state and the results of each episode. A finished episode continues to
be computed but is masked, so steps after `done` never count. Shapes are constants of the run, because XLA may give
different bits for another batch shape.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from es_service.protocol.episodes import OF_STEPS
from es_service.protocol.messages import EVALUATION_EPISODES_PER_CHUNK, SIGNS, WorkerSpec
from es_service.protocol.noise import NORMAL_STD, normal_integers
from es_service.protocol.policies import POLICY_SLOTS, explicit
from es_service.protocol.policy_spec import PolicySpec, layers_of_noise, numbers, product_unit
from workers.compiling import Compilable, jitted
from workers.environments import Environment
from workers.episode import Carry, episode_steps
from workers.policy import act, split_layers

ActOfLanes = Callable[[Any, Any], tuple[Any, Any]]
"""Function (memory_L_H, observation_L_O) -> (outputs_L_A, memory_L_H) of the policies of all lanes, as `act`."""


def make_training_rollout(environment: Environment, spec: WorkerSpec, *, in_pairs: bool = False) -> Compilable:
    """Rollout of one training chunk, see `ChunkFunctions.training`.

    Pairs step in blocks of `rollout_block_pairs`, one block after the other, so that a block's weights stay in cache.

    Args:
        in_pairs: whether policies are computed by `act_in_pairs`, which is how a GPU does it.
    """
    episodes = _make_member_episodes(environment, spec)
    block_pairs = spec.rollout_block_pairs
    rank = spec.noise_rank
    drawn = numbers(spec.policy, rank) if rank else spec.policy.parameters
    coordinates_N = np.arange(drawn, dtype=np.uint32)
    signs_S = np.asarray(SIGNS, np.float32)

    def rollout(centre_D, unit, mean_O, std_O, noise_keys_P, reset_keys_P_S_E, action_keys_P_S_E):
        def block(keys):
            noise_keys_P, reset_keys_P_S_E, action_keys_P_S_E = keys
            noise_P_N = jax.vmap(lambda key: normal_integers(jnp, key, coordinates_N))(noise_keys_P)
            if rank:
                policies = act_low_rank(spec.policy, rank, centre_D, unit, noise_P_N.astype(jnp.float32))
            elif in_pairs:
                policies = act_in_pairs(spec.policy, centre_D, unit, noise_P_N)
            else:
                offset_P_D = unit * noise_P_N.astype(jnp.float32)
                parameters_P_S_D = centre_D + signs_S[None, :, None] * offset_P_D[:, None, :]
                policies = _act_each(spec.policy, parameters_P_S_D.reshape(2 * block_pairs, -1))
            result_PS = episodes(
                policies,
                mean_O,
                std_O,
                *(keys.reshape(2 * block_pairs, *keys.shape[2:]) for keys in (reset_keys_P_S_E, action_keys_P_S_E)),
            )
            return jax.tree.map(lambda x: x.reshape(block_pairs, 2, *x.shape[1:]), result_PS)

        blocks = spec.chunk_pairs // block_pairs
        keys = (noise_keys_P, reset_keys_P_S_E, action_keys_P_S_E)
        by_block = jax.tree.map(lambda x: x.reshape(blocks, block_pairs, *x.shape[1:]), keys)
        return jax.tree.map(lambda x: x.reshape(spec.chunk_pairs, *x.shape[2:]), lax.map(block, by_block))

    return jitted(rollout)


def make_evaluation_rollout(environment: Environment, spec: WorkerSpec) -> Compilable:
    """Rollout of one evaluation chunk, see `ChunkFunctions.evaluation`.

    Episodes that are not wanted are computed all the same, since a program that stopped earlier could have other bits.
    """
    evaluated = _make_episodes(environment, spec, training=False)
    episodes = jitted(lambda centre_D, *given: evaluated(_act_shared(spec.policy, centre_D), *given))
    return Compilable(
        lambda centre_D, mean_O, std_O, reset_keys_E, wanted_E: episodes(centre_D, mean_O, std_O, reset_keys_E),
        lambda centre_D, mean_O, std_O, reset_keys_E, wanted_E: episodes.compile(centre_D, mean_O, std_O, reset_keys_E),
    )


def make_policy_rollout(environment: Environment, spec: WorkerSpec) -> Compilable:
    """Rollout of one policy chunk, see `ChunkFunctions.policies`, for at most POLICY_SLOTS lanes.

    Lanes repeat to fill the chunk, whose shape never changes.
    """
    evaluated = _make_episodes(environment, spec, training=False, per_lane_statistics=True)
    episodes = jitted(lambda parameters_L_D, *given: evaluated(_act_each(spec.policy, parameters_L_D), *given))

    def filled(policies, mean_L_O, std_L_O, policy_L, reset_keys_L):
        lane_L = np.minimum(np.arange(POLICY_SLOTS), len(policy_L) - 1)
        parameters_L_D = explicit(policies)[policy_L[lane_L]]
        return parameters_L_D, mean_L_O[lane_L], std_L_O[lane_L], reset_keys_L[lane_L]

    def rollout(*given):
        lanes = len(given[-1])
        return jax.tree.map(lambda x: np.asarray(x)[:lanes], episodes(*filled(*given)))

    return Compilable(rollout, lambda *given: episodes.compile(*filled(*given)))


def make_watched_rollout(environment: Environment, spec: WorkerSpec, *, per_lane_weights: bool) -> Callable[..., Carry]:
    """Rollout of one evaluation episode that keeps what it went through, for replays; compiled at its first call.

    The episode runs in its slot of a whole chunk, with the loop of `_make_episodes`, since XLA may give other bits for
    another shape. The loop keeps the carry that each step begins with, which no computation of the step depends on.

    Args:
        per_lane_weights: whether the episode is that of an explicit policy, or else that of a centre.

    Returns:
        f(centre_D, mean_O, std_O, reset_key_4, slot) -> Carry with leading axis [T + 1], of the reset and after every
        step until the episode is done; the rest is 0.
    """
    lanes = POLICY_SLOTS if per_lane_weights else EVALUATION_EPISODES_PER_CHUNK
    episodes = _make_episodes(environment, spec, training=False, per_lane_statistics=per_lane_weights, watched=True)
    policies = _act_each if per_lane_weights else _act_shared

    def rollout(centre_D, mean_O, std_O, reset_key, slot):
        def in_lanes(array):
            return jnp.broadcast_to(array, (lanes, *array.shape))

        if per_lane_weights:
            centre_D, mean_O, std_O = map(in_lanes, (centre_D, mean_O, std_O))
        return episodes(policies(spec.policy, centre_D), mean_O, std_O, in_lanes(reset_key), slot=slot)

    return jax.jit(rollout)


def make_gradient_sum(parameters: int) -> Compilable:
    """Sum of weighted noise of one block of pairs, see `ChunkFunctions.gradient_sum`.

    The noise is made of integers, and the sum is scaled to standard normal once, at the end.
    """
    coordinates_D = np.arange(parameters, dtype=np.uint32)

    def gradient_sum(weights_P, noise_keys_P):
        def add_pair(pair, sum_D):
            noise_D = normal_integers(jnp, noise_keys_P[pair], coordinates_D).astype(jnp.float32)
            return sum_D + weights_P[pair] * noise_D

        sum_D = lax.fori_loop(0, weights_P.shape[0], add_pair, jnp.zeros(parameters, jnp.float32))
        return sum_D * np.float32(1.0 / NORMAL_STD)

    return jitted(gradient_sum)


def make_low_rank_gradient_sum(policy: PolicySpec, rank: int) -> Compilable:
    """Sum of weighted noise of low rank of one block of pairs, with the interface of `make_gradient_sum`.

    The sum over the pairs of a block is one matrix product for each layer.
    """
    coordinates_N, layers = np.arange(numbers(policy, rank), dtype=np.uint32), layers_of_noise(policy, rank)
    of_numbers, of_products = np.float32(1.0 / NORMAL_STD), np.float32(product_unit(rank) / NORMAL_STD)

    def gradient_sum(weights_P, noise_keys_P):
        drawn_P_N = jax.vmap(lambda key: normal_integers(jnp, key, coordinates_N))(noise_keys_P).astype(jnp.float32)
        weighted_P_N, parts = weights_P[:, None] * drawn_P_N, []
        for left, right, bias in layers:
            left_PR_I, right_PR_J = (
                drawn[:, at].reshape(-1, at.shape[1]) for drawn, at in ((weighted_P_N, left), (drawn_P_N, right))
            )
            parts.append((left_PR_I.T @ right_PR_J).reshape(-1) * of_products)
            parts += [] if bias is None else [weighted_P_N[:, bias].sum(axis=0) * of_numbers]
        return jnp.concatenate(parts)

    return jitted(gradient_sum)


def _act_each(policy: PolicySpec, parameters_L_D: Any) -> ActOfLanes:
    """The policies of lanes that each have their own parameters."""
    layers = jax.vmap(partial(split_layers, policy))(parameters_L_D)  # inside a loop this would copy them in every step
    acts = jax.vmap(partial(act, jnp, policy))
    return lambda memory_L_H, observation_L_O: acts(layers, memory_L_H, observation_L_O)


def _act_shared(policy: PolicySpec, parameters_D: Any) -> ActOfLanes:
    """The policies of lanes that share their parameters."""
    layers = split_layers(policy, parameters_D)
    acts = jax.vmap(partial(act, jnp, policy), in_axes=(None, 0, 0))
    return lambda memory_L_H, observation_L_O: acts(layers, memory_L_H, observation_L_O)


def _make_member_episodes(environment: Environment, spec: WorkerSpec):
    """Function that runs all episodes of each member, one after another.

    Returns:
        f(policies, mean_O, std_O, reset_keys_M_E_4, action_keys_M_E_4) -> Episodes with leading axes [M, E].
    """
    one_each = _make_episodes(environment, spec, training=True)

    def episodes(policies, mean_O, std_O, reset_keys_M_E, action_keys_M_E):
        by_episode = (jnp.swapaxes(reset_keys_M_E, 0, 1), jnp.swapaxes(action_keys_M_E, 0, 1))
        all_E_M = lax.map(lambda keys: one_each(policies, mean_O, std_O, *keys), by_episode)
        return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), all_E_M)

    return episodes


def _make_episodes(
    environment: Environment,
    spec: WorkerSpec,
    *,
    training: bool,
    per_lane_statistics: bool = False,
    watched: bool = False,
):
    """Function that runs one episode per lane.

    Returns:
        f(policies, mean_O, std_O, reset_keys_L_4[, action_keys_L_4]) -> Episodes with leading axis [L]. In training
        there is action noise. With `per_lane_statistics` every lane has its own statistics [L, O]. If `watched`, the
        function has an argument `slot` and returns the carries [T + 1] of that lane instead.
    """
    steps = episode_steps(environment, spec, training=training)
    of_statistics = 0 if per_lane_statistics else None
    observe = jax.vmap(steps.normalised_observation, in_axes=(0, of_statistics, of_statistics))
    advance = jax.vmap(steps.advance, in_axes=(0, of_statistics, 0, 0, 0))

    def episodes(policies: ActOfLanes, mean_O, std_O, reset_keys_L, action_keys_L=None, slot=None):
        keys_L = reset_keys_L if action_keys_L is None else action_keys_L

        def keep(seen_T: Carry | None, step: Any, carry: Carry) -> Carry | None:
            return jax.tree.map(lambda kept, now: kept.at[step].set(now[slot]), seen_T, carry) if watched else None

        def body(at: tuple[Any, Carry, Any, Carry | None]) -> tuple[Any, Carry, Any, Carry | None]:
            step, carry, of_steps_T_L, seen_T = at
            x_L_O = observe(carry, mean_O, std_O)
            outputs_L, memory_L_H = policies(carry.memory_H, x_L_O)
            moved = advance(carry, mean_O, x_L_O, outputs_L, keys_L)._replace(memory_H=memory_L_H)
            of_steps_T_L = {name: kept.at[step].set(moved.episode.outputs[name]) for name, kept in of_steps_T_L.items()}
            return step + 1, moved, of_steps_T_L, keep(seen_T, step, carry)

        def unfinished(at: tuple[Any, Carry, Any, Carry | None]):
            step, carry, *_ = at
            return (step < spec.episode_steps) & carry.alive.any()

        def room(steps: int, x: Any) -> Any:
            return jnp.zeros((steps, *x.shape), x.dtype)

        start, seen_T = jax.vmap(steps.begin)(reset_keys_L), None
        if watched:
            seen_T = jax.tree.map(lambda x: room(spec.episode_steps + 1, x[0]), start)
        of_steps_T_L = {
            name: room(spec.episode_steps, x) for name, x in start.episode.outputs.items() if name in OF_STEPS
        }
        step, end, of_steps_T_L, seen_T = lax.while_loop(unfinished, body, (jnp.int32(0), start, of_steps_T_L, seen_T))
        of_steps_L_T = {name: jnp.swapaxes(kept, 0, 1) for name, kept in of_steps_T_L.items()}
        return keep(seen_T, step, end) if watched else end.episode.with_steps(of_steps_L_T)

    return episodes


# Perturbed policies of all members of a block, or on a GPU of a population: a step of all of them at a time.
#
# **Noise of each parameter.** The weights of member s of pair p are centre + sign(s) * unit * noise(p). The product of
# the centre's weights is one matrix product for all members, and the noise of a pair, a byte for each weight, is read
# once for both of its members. This is the same policy as that of weights added first, but its sums are rounded
# differently.
#
# **Noise of low rank.** A member's layer is x (W +- e A^T B) = x W +- e (x A^T) B: one product with the centre's
# weights for all members, and two thin ones for each. The weights of a member are never made.

SIGNS_S = np.asarray(SIGNS, np.float32)


class PairLayer(NamedTuple):
    """Weights of a layer of all members."""

    centre_I_J: Any
    half_noise_P_J_I: Any
    """The noise integers k of `normal_integers`, which are odd, as (k - 1) / 2: bytes, with the inputs last."""


def act_in_pairs(policy: PolicySpec, centre_D: Any, unit: Any, noise_P_D: Any) -> Any:
    """Function (memory_M_H, observation_M_O) -> (outputs_M_A, memory_M_H), as `act` of every member.

    Args:
        centre_D: parameters of the centre.
        unit: sigma / NORMAL_STD.
        noise_P_D: noise integers of each pair, `normal_integers`. The two members of a pair are neighbours.
    """
    noise = jax.vmap(lambda noise_D: split_layers(policy, noise_D))(noise_P_D)
    centre = split_layers(policy, centre_D)
    layers = [
        (
            PairLayer(weights, ((jnp.swapaxes(k_P_I_J, 1, 2) - 1) // 2).astype(jnp.int8)),
            None if biases is None else (biases, k_P_J.astype(jnp.float32)),
        )
        for (weights, biases), (k_P_I_J, k_P_J) in zip(centre, noise, strict=True)
    ]
    step_S_1 = (unit * SIGNS_S)[:, None]

    def dense(x_M_I: Any, layer: Any, biases: Any) -> Any:
        x_P_S_I = x_M_I.reshape(-1, 2, x_M_I.shape[-1])
        half_P_J_I = layer.half_noise_P_J_I.astype(jnp.float32)
        sums = [jnp.sum(x_P_S_I[:, s, None, :] * half_P_J_I, axis=2) for s in range(2)]
        own_P_S_J = 2.0 * jnp.stack(sums, axis=1) + jnp.sum(x_P_S_I, axis=-1, keepdims=True)
        shared_M_J = x_M_I @ layer.centre_I_J
        if biases is not None:
            shared_M_J, own_P_S_J = shared_M_J + biases[0], own_P_S_J + biases[1][:, None, :]
        return shared_M_J + (step_S_1 * own_P_S_J).reshape(shared_M_J.shape)

    return lambda memory_M_H, observation_M_O: act(jnp, policy, layers, memory_M_H, observation_M_O, dense)


class LowRankLayer(NamedTuple):
    """Weights of a layer of all members."""

    centre_I_J: Any
    left_P_R_I: Any
    """Noise integers of A, of each pair."""
    right_P_R_J: Any
    """Noise integers of B, of each pair."""


def act_low_rank(policy: PolicySpec, rank: int, centre_D: Any, unit: Any, drawn_P_N: Any) -> Any:
    """Function (memory_M_H, observation_M_O) -> (outputs_M_A, memory_M_H), as `act` of every member.

    Args:
        centre_D: parameters of the centre.
        unit: sigma / NORMAL_STD.
        drawn_P_N: noise integers of each pair, `protocol.low_rank.numbers` of them, as float32. The two members of a
            pair are neighbours.
    """
    layers = [
        (
            LowRankLayer(weights, drawn_P_N[:, noise.left], drawn_P_N[:, noise.right]),
            None if noise.bias is None else (biases, drawn_P_N[:, noise.bias]),
        )
        for (weights, biases), noise in zip(split_layers(policy, centre_D), layers_of_noise(policy, rank), strict=True)
    ]
    step_S = unit * SIGNS_S

    def dense(x_M_I: Any, layer: LowRankLayer, biases: Any) -> Any:
        x_P_S_I = x_M_I.reshape(-1, 2, x_M_I.shape[-1])
        thin_P_S_R = jnp.einsum("psi,pri->psr", x_P_S_I, layer.left_P_R_I) * product_unit(rank)
        moved_P_S_J = jnp.einsum("psr,prj->psj", thin_P_S_R, layer.right_P_R_J)
        shared_M_J = x_M_I @ layer.centre_I_J
        if biases is not None:
            shared_M_J, moved_P_S_J = shared_M_J + biases[0], moved_P_S_J + biases[1][:, None, :]
        return shared_M_J + (step_S[:, None] * moved_P_S_J).reshape(shared_M_J.shape)

    return lambda memory_M_H, observation_M_O: act(jnp, policy, layers, memory_M_H, observation_M_O, dense)
