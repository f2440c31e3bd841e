"""One episode of one member as step functions, which `xla` maps over lanes and `simd` compiles.

`normalised_observation` and `advance` together are one control step; the policy acts between them. A finished episode
continues to be computed but is masked, so steps after `done` never count.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from es_service.protocol.messages import TRACE_POINTS, WorkerSpec
from es_service.protocol.noise import NORMAL_STD, normal_integers
from workers.environments import Environment
from workers.outputs import Step, named_outputs
from workers.policies.outputs import action, drawn_action
from workers.policies.policy import initial_memory, normalise
from workers.rollouts.backend import BAD_REWARD, NO_FAULT, Episodes


class Carry(NamedTuple):
    """State of an episode between two steps."""

    state: Any
    alive: Any
    memory_H: Any
    """Memory of the policy; None for one without."""
    episode: Episodes


class EpisodeSteps(NamedTuple):
    """An episode as pure functions of one lane."""

    begin: Callable[[Any], Carry]
    """Function from the stream key of the reset to a carry."""
    normalised_observation: Callable[[Carry, Any, Any], Any]
    """Function (carry, mean_O, std_O) -> normalised observation [O]."""
    advance: Callable[[Carry, Any, Any, Any, Any], Carry]
    """Function (carry, mean_O, normalised observation, outputs of the policy's last layer, stream key of the action
    noise) -> carry; only training uses the key. The memory stays."""


def episode_steps(
    environment: Environment,
    spec: WorkerSpec,
    *,
    training: bool,
    inputs_O: Any = slice(None),
    finds_faults: bool = True,
) -> EpisodeSteps:
    """Step functions of training episodes (action noise, sums of observations) or of evaluation episodes (traces).

    Both have the outputs that the spec names. Of those of `OF_STEPS` a carry has the value after the newest step; what
    runs the episode keeps the values of all.

    Args:
        inputs_O: indices of the environment's observations that are computed, for the policy and for the sums.
        finds_faults: whether episodes say where something was not finite (`Episodes.fault`). Otherwise the results of
            an episode whose policy was given such an input are not all finite, at the least cost: in training the sums
            of its observations, in evaluations its return.
    """
    action_unit = np.float32(spec.action_noise / NORMAL_STD)
    action_size = spec.policy.widths[-1]
    noisy = spec.action_noise > 0.0
    named = named_outputs(spec.outputs)
    points = min(TRACE_POINTS, spec.episode_steps + 1)
    numbers_O = np.arange(spec.policy.widths[0], dtype=np.int32)[inputs_O]
    last_steps_T = (np.arange(points) * spec.episode_steps // (points - 1)).astype(np.int32)

    def observe(state: Any) -> Any:
        return environment.observe(state)[inputs_O]

    def begin(reset_key: Any) -> Carry:
        state = environment.reset(reset_key)
        start_B = jnp.asarray(environment.descriptor(state), jnp.float32)
        zero, zeros_A = jnp.float32(0.0), jnp.zeros(action_size, jnp.float32)
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
            outputs={name: output.begin(environment, state, zeros_A) for name, output in named.items()},
            of_steps={},
            fault=jnp.array([0, NO_FAULT], jnp.int32) if finds_faults else None,
        )
        return Carry(state, jnp.array(True), initial_memory(jnp, spec.policy), nothing)

    def normalised_observation(carry: Carry, mean_O: Any, std_O: Any) -> Any:
        return normalise(jnp, observe(carry.state), mean_O, std_O, spec.observation_clip)

    def training_action(outputs: Any, key: Any, step: Any) -> Any:
        coordinates_A = step.astype(jnp.uint32) * np.uint32(action_size) + jnp.arange(action_size, dtype=jnp.uint32)
        action_A = drawn_action(jnp, spec.policy.output, outputs, key, coordinates_A)
        if not noisy:
            return action_A
        return action_A + action_unit * normal_integers(jnp, key, coordinates_A).astype(jnp.float32)

    def traced(trace_T_B: Any, steps: Any, descriptor_B: Any) -> Any:
        """Trace whose points at this step and later are set to this descriptor; later steps overwrite them."""
        reached_T = steps + 1 <= last_steps_T
        return jnp.where(reached_T[:, None], descriptor_B, trace_T_B)

    def fault(carry: Carry) -> Any:
        """`Episodes.fault` after a step that begins with this carry.

        It looks at observations, since what a policy makes of them may hide a NaN, as a choice among actions does, and
        behind a barrier, because another use of a value would change which operations XLA fuses, and so their bits. For
        the same reason a reward is seen in the return, a step later.
        """
        state, before = lax.optimization_barrier((carry.state, carry.episode))
        observation_O = observe(state)
        is_bad_O = jnp.isnan(observation_O) if spec.observation_clip is not None else ~jnp.isfinite(observation_O)
        number = jnp.where(is_bad_O, numbers_O, np.int32(NO_FAULT)).min()
        step = before.steps + (number != NO_FAULT)
        number = jnp.minimum(number, jnp.where(jnp.isfinite(before.returns), np.int32(NO_FAULT), np.int32(BAD_REWARD)))
        any_input = np.int32(BAD_REWARD - 1)
        is_graver = jnp.maximum(number, any_input) < jnp.maximum(before.fault[1], any_input)
        return jnp.where(is_graver, jnp.stack([step, number]), before.fault)

    def advance(carry: Carry, mean_O: Any, x_O: Any, outputs: Any, action_key: Any) -> Carry:
        alive, before = carry.alive, carry.episode
        if training:
            action_A = training_action(outputs, action_key, before.steps)  # a living episode has done as many steps
        else:
            action_A = action(jnp, spec.policy.output, outputs)
        state, reward, done = environment.step(carry.state, action_A)
        step = Step(carry.state, action_A, state, reward, done)
        distance = jnp.asarray(environment.goal_distance(state), jnp.float32)
        descriptor_B = jnp.asarray(environment.descriptor(state), jnp.float32)
        returns = before.returns + reward
        if not training and not finds_faults:
            total = x_O.sum()
            returns = returns + (total - total)  # 0 if all are finite, else NaN
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
            outputs={name: output.after(environment, step, before.outputs[name]) for name, output in named.items()},
            of_steps={},
            fault=fault(carry) if finds_faults else None,
        )
        masked = jax.tree.map(lambda new, old: jnp.where(alive, new, old), after, before)
        return Carry(state, alive & ~done, carry.memory_H, masked)

    return EpisodeSteps(begin, normalised_observation, advance)
