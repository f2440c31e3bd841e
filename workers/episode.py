"""One episode of one member, step by step: what `xla` maps over lanes and `simd` compiles for them.

`look` and `move` together are a control step; the policy acts between them. A finished episode rides along masked, so
steps after `done` never count.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.messages import TRACE_POINTS, WorkerSpec
from es_service.protocol.noise import NORMAL_STD, normal_integers
from workers.environments import Environment
from workers.policy import normalise


class Episodes(NamedTuple):
    """What is left of an episode; of a batch of them, with leading axes as the caller's."""

    fitness: Any
    returns: Any
    descriptor: Any
    steps: Any
    goal_distance: Any
    """[..., 2]: at the end and at its least."""
    shifted_sum_O: Any
    """Sum over counted steps of (observation - statistics' mean); float32. Exact enough for one episode if that mean is
    near the observations'; before any are known (in generation 1, or in blocks that run with an elite's statistics from
    random weights) if their mean is below a thousand standard deviations. Of evaluations, which feed no statistics:
    empty."""
    shifted_square_sum_O: Any
    trace_T_B: Any
    """Of evaluations: the descriptor along the episode; empty in training. Point k is where it was after
    k / (points - 1) of its steps, or ended before."""


class Carry(NamedTuple):
    """An episode between two steps."""

    state: Any
    alive: Any
    episode: Episodes


class EpisodeSteps(NamedTuple):
    """An episode as pure functions of one lane."""

    begin: Callable[[Any], Carry]
    """Stream key of the reset -> carry."""
    look: Callable[[Carry, Any, Any], Any]
    """(carry, mean_O, std_O) -> normalised observation [O]."""
    move: Callable[[Carry, Any, Any, Any], Carry]
    """(carry, mean_O, action [A], stream key of action noise) -> carry. The key matters only in training."""


def episode_steps(
    environment: Environment, spec: WorkerSpec, *, training: bool, inputs_O: Any = slice(None)
) -> EpisodeSteps:
    """The steps of training episodes, with action noise and sums of observations, or of evaluations, with traces.

    Args:
        inputs_O: which of the environment's observations there are, for the policy and for the sums.
    """
    action_unit = np.float32(spec.action_noise / NORMAL_STD)
    action_size = spec.policy.widths[-1]
    noisy = training and spec.action_noise > 0.0
    points = min(TRACE_POINTS, spec.episode_steps + 1)
    last_steps_T = (np.arange(points) * spec.episode_steps // (points - 1)).astype(np.int32)

    def observe(state: Any) -> Any:
        return environment.observe(state)[inputs_O]

    def begin(reset_key: Any) -> Carry:
        state = environment.reset(reset_key)
        start_B = jnp.asarray(environment.descriptor(state), jnp.float32)
        zero = jnp.float32(0.0)
        sums_O = jnp.zeros(observe(state).shape if training else (0,), jnp.float32)
        trace_T_B = jnp.broadcast_to(start_B, (0 if training else points, *start_B.shape))
        nothing = Episodes(
            fitness=zero,
            returns=zero,
            descriptor=jnp.zeros_like(start_B),
            steps=jnp.int32(0),
            goal_distance=jnp.full(2, jnp.nan, jnp.float32),
            shifted_sum_O=sums_O,
            shifted_square_sum_O=sums_O,
            trace_T_B=trace_T_B,
        )
        return Carry(state, jnp.array(True), nothing)

    def look(carry: Carry, mean_O: Any, std_O: Any) -> Any:
        return normalise(jnp, observe(carry.state), mean_O, std_O, spec.observation_clip)

    def action_noise(key: Any, step: Any) -> Any:
        coordinates_A = step.astype(jnp.uint32) * np.uint32(action_size) + jnp.arange(action_size, dtype=jnp.uint32)
        return action_unit * normal_integers(jnp, key, coordinates_A).astype(jnp.float32)

    def traced(trace_T_B: Any, steps: Any, descriptor_B: Any) -> Any:
        """Point k and all later ones are here for now, from the step on that is k / (points - 1) of them."""
        reached_T = steps + 1 <= last_steps_T
        return jnp.where(reached_T[:, None], descriptor_B, trace_T_B)

    def move(carry: Carry, mean_O: Any, action_A: Any, action_key: Any) -> Carry:
        alive, before = carry.alive, carry.episode
        if noisy:
            action_A = action_A + action_noise(action_key, before.steps)  # those of a living episode are its step
        state, reward, done = environment.step(carry.state, action_A)
        distance = jnp.asarray(environment.goal_distance(state), jnp.float32)
        descriptor_B = jnp.asarray(environment.descriptor(state), jnp.float32)
        returns = before.returns + reward
        shifted_O = observe(carry.state) - mean_O if training else before.shifted_sum_O
        after = Episodes(
            fitness=reward if spec.fitness == "final" else returns,
            returns=returns,
            descriptor=descriptor_B,
            steps=before.steps + 1,
            goal_distance=jnp.stack([distance, jnp.fmin(before.goal_distance[1], distance)]),
            shifted_sum_O=before.shifted_sum_O + shifted_O,
            shifted_square_sum_O=before.shifted_square_sum_O + shifted_O * shifted_O,
            trace_T_B=before.trace_T_B if training else traced(before.trace_T_B, before.steps, descriptor_B),
        )
        masked = jax.tree.map(lambda new, old: jnp.where(alive, new, old), after, before)
        return Carry(state, alive & ~done, masked)

    return EpisodeSteps(begin, look, move)
