"""Code shared by rollouts of JAX tasks: which episodes are invalid and why, recordings of episodes that were watched,
and steps with random actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Literal
from jax.lax import GatherScatterMode

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


# Functions of JAX with sums in place of scatters that add, for GPUs.
#
# With deterministic operations, XLA sorts what such a scatter adds, which takes most of the time of a step of Brax. It
# also adds to another environment of the batch what JAX's index -1 should have dropped (seen with jaxlib 0.11.2 on an
# H200): ants had forces of their neighbours. A sum over all updates, of which those of other rows count as 0, needs no
# order and drops what it should. Other scatters get a place for what is dropped.

CALLS = ("jit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "remat2")
"""Primitives that only call a function."""


def without_scatters(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with every scatter that adds whole rows, such as `segment_sum` and `x.at[index].add(row)`, as a sum
    of all rows; other scatters stay, with indices inside of what they change. The order of additions is XLA's, and so
    may be other bits."""

    def dense(*arguments: Any) -> Any:
        closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
        return jax.tree.unflatten(jax.tree.structure(shape), _evaluated(closed, jax.tree.leaves(arguments)))

    return dense


def _evaluated(closed: ClosedJaxpr, inputs: Sequence[Any]) -> list[Any]:
    jaxpr = closed.jaxpr
    values: dict[Any, Any] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*closed.consts, *inputs], strict=True))

    def read(atom: Any) -> Any:
        aval: Any = atom.aval
        return jnp.asarray(atom.val, aval.dtype) if isinstance(atom, Literal) else values[atom]

    for equation in jaxpr.eqns:
        outputs = _outputs(equation, [read(atom) for atom in equation.invars])
        values.update(zip(equation.outvars, outputs, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _outputs(equation: Any, inputs: list[Any]) -> Sequence[Any]:
    """Outputs of an equation; the jaxprs in it are evaluated in the same way."""
    name, params = equation.primitive.name, equation.params
    if name == "scatter-add" and _adds_rows(params, *(atom.aval for atom in equation.invars)):
        return [_sum_of_rows(*inputs)]
    if name in CALLS:
        inner = params.get("jaxpr", params.get("call_jaxpr"))
        return _evaluated(inner if hasattr(inner, "consts") else ClosedJaxpr(inner, ()), inputs)
    if name.startswith("scatter") and _drops(params):
        return [_with_a_place_for_the_dropped(equation, *inputs)]
    inner = {name: _without(value) for name, value in params.items() if _has_jaxprs(value)}  # of a loop or a branch
    outputs = equation.primitive.bind(*inputs, **params | inner)
    return outputs if equation.primitive.multiple_results else [outputs]


def _has_jaxprs(value: Any) -> bool:
    return isinstance(value, ClosedJaxpr) or (isinstance(value, tuple) and any(map(_has_jaxprs, value)))


def _without(value: Any) -> Any:
    """A jaxpr, or a tuple of some, that is evaluated in the same way."""
    if isinstance(value, tuple):
        return tuple(map(_without, value))
    like = [jax.ShapeDtypeStruct(variable.aval.shape, variable.aval.dtype) for variable in value.jaxpr.invars]
    return jax.make_jaxpr(lambda *inputs: _evaluated(value, inputs))(*like)


def _adds_rows(params: dict[str, Any], operand: Any, indices: Any, updates: Any) -> bool:
    """Whether a scatter adds rows [K, ...] to the rows [N, ...] that K numbers name, and drops those of other
    numbers."""
    numbers = params["dimension_numbers"]
    return (
        params["mode"] != GatherScatterMode.CLIP
        and indices.ndim == 2
        and indices.shape[-1] == 1
        and tuple(numbers.inserted_window_dims) == (0,)
        and tuple(numbers.scatter_dims_to_operand_dims) == (0,)
        and not numbers.operand_batching_dims
        and tuple(numbers.update_window_dims) == tuple(range(1, operand.ndim))
        and updates.shape == (indices.shape[0], *operand.shape[1:])
    )


def _sum_of_rows(operand: Any, indices: Any, updates: Any) -> Any:
    is_row_N_K = indices[None, :, 0] == jnp.arange(operand.shape[0], dtype=indices.dtype)[:, None]
    is_row = is_row_N_K.reshape(*is_row_N_K.shape, *[1] * (operand.ndim - 1))
    return operand + jnp.where(is_row, updates[None], jnp.zeros((), updates.dtype)).sum(1, updates.dtype)


def _drops(params: dict[str, Any]) -> bool:
    """Whether a scatter drops updates by their indices, which name single places along their axes."""
    numbers = params["dimension_numbers"]
    inserted = set(numbers.inserted_window_dims)
    drops = params["mode"] == GatherScatterMode.FILL_OR_DROP
    return drops and set(numbers.scatter_dims_to_operand_dims) <= inserted and not numbers.operand_batching_dims


def _with_a_place_for_the_dropped(equation: Any, operand: Any, indices: Any, updates: Any) -> Any:
    """The scatter into an operand that is longer by one along each axis of the indices, for the dropped updates."""
    axes = equation.params["dimension_numbers"].scatter_dims_to_operand_dims
    sizes = jnp.asarray([operand.shape[axis] for axis in axes], indices.dtype)
    is_kept = ((indices >= 0) & (indices < sizes)).all(axis=-1, keepdims=True)
    longer = jnp.pad(operand, [(0, int(axis in axes)) for axis in range(operand.ndim)])
    scattered = equation.primitive.bind(longer, jnp.where(is_kept, indices, sizes), updates, **equation.params)
    return scattered[tuple(slice(size) for size in operand.shape)]
