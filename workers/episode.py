"""One episode of one member as step functions, which `xla` maps over lanes and `simd` compiles.

`normalised_observation` and `advance` together are one control step; the policy acts between them. A finished episode
continues to be computed but is masked, so steps after `done` never count.

OUTPUTS are computed only if a run names them, besides what every result has; their names are in
`es_service/protocol/episodes.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from es_service.protocol.episodes import AT_THE_END, METRICS, OF_STEPS
from es_service.protocol.messages import TRACE_POINTS, WorkerSpec
from es_service.protocol.noise import NORMAL_STD, normal_integers
from workers.environments import Environment
from workers.policy import action, drawn_action, initial_memory, normalise
from workers.rollouts.backend import BAD_REWARD, NO_FAULT, Episodes


class EpisodeStep(NamedTuple):
    before: Any
    action_A: Any
    """Action as the environment gets it, with its noise."""
    state: Any
    reward: Any
    done: Any


class EpisodeOutput(NamedTuple):
    """An output as pure functions of one episode; its value is an array whose shape and dtype stay the same.

    The result of an episode has the value after its last valid step. An output of `OF_STEPS` has that after each of
    them instead.
    """

    begin: Callable[[Environment, Any, Any], Any]
    """Function (environment, state of the reset, action of zeros [A]) -> value before the first step."""
    after: Callable[[Environment, EpisodeStep, Any], Any]
    """Function (environment, step, value before it) -> value after it. Steps after `done` never count."""


def named_outputs(names: Sequence[str]) -> dict[str, EpisodeOutput]:
    """The outputs with these names. Raises ValueError for a name that none has."""
    unknown = sorted({*names} - {*OUTPUTS})
    if unknown:
        raise ValueError(f"no output of episodes has the name {unknown[0]!r}; choose among {', '.join(OUTPUTS)}")
    return {name: OUTPUTS[name] for name in names}


def _of_state(value: Callable[[Environment, Any], Any]) -> EpisodeOutput:
    return EpisodeOutput(
        lambda environment, state, _: value(environment, state),
        lambda environment, step, _: value(environment, step.state),
    )


def _success(environment: Environment, state: Any, before: Any) -> Any:
    return jnp.asarray(environment.success(state, before), bool)


def _metrics(environment: Environment, state: Any) -> Any:
    assert environment.metrics is not None, "a run names this output only if its task has metrics"
    return jnp.asarray(environment.metrics(state), jnp.float32)


def _observation(environment: Environment, state: Any) -> Any:
    return jnp.asarray(environment.observe(state), jnp.float32)


_REWARD = EpisodeOutput(
    lambda environment, state, _: jnp.float32(0.0),
    lambda environment, step, before: jnp.asarray(step.reward, jnp.float32),
)
OUTPUTS: Mapping[str, EpisodeOutput] = {
    "success": EpisodeOutput(
        lambda environment, state, _: _success(environment, state, jnp.array(False)),
        lambda environment, step, before: _success(environment, step.state, before),
    ),
    "last_reward": _REWARD,
    "first_observation": EpisodeOutput(
        lambda environment, state, _: _observation(environment, state), lambda environment, step, before: before
    ),
    "last_observation": _of_state(_observation),
    METRICS: _of_state(_metrics),
    "observation": EpisodeOutput(
        lambda environment, state, _: _observation(environment, state),
        lambda environment, step, before: _observation(environment, step.before),
    ),
    "action": EpisodeOutput(
        lambda environment, state, zeros_A: zeros_A,
        lambda environment, step, before: jnp.asarray(step.action_A, jnp.float32),
    ),
    "reward": _REWARD,
    "done": EpisodeOutput(
        lambda environment, state, _: jnp.array(False),
        lambda environment, step, before: jnp.asarray(step.done, bool),
    ),
    "step_descriptor": _of_state(lambda environment, state: jnp.asarray(environment.descriptor(state), jnp.float32)),
}
assert {*OUTPUTS} == {*AT_THE_END, *OF_STEPS}, "each name of protocol/episodes.py has its functions here"


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
        step = EpisodeStep(carry.state, action_A, state, reward, done)
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
