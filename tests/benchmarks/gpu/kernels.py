"""Functions of a task for a GPU, one environment a thread: `ptx.ptx` makes kernels of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from es_service.protocol.messages import WorkerSpec
from es_service.protocol.policy_spec import PolicySpec
from workers.environments import SHIPPED, make_environment
from workers.episode import episode_steps
from workers.simd.backend.function_builder import FunctionBuilder
from workers.simd.backend.ptx import Pointer, StepCall, lane_function
from workers.simd.backend.target import Target
from workers.simd.episodes.rollout import always_zero
from workers.simd.gpu.program import KEY, function_of, step_functions, words_in

HIDDEN = 256
"""Units of each of the two hidden layers of the policies."""


class Physics(NamedTuple):
    """A task's resets and control steps without a policy, as pure functions of one lane."""

    begin: Callable[[Any], Any]
    """Function from a key to (state, return)."""
    step: Callable[[Any, Any], Any]
    """Function ((state, return), action) -> (state, return)."""
    carry: Any
    """Shapes and dtypes of (state, return)."""
    action: Any


def physics_of(task: str) -> Physics:
    """The physics of a shipped task. The return is the sum of rewards, also of those after the end of an episode."""
    environment = make_environment(task, {})

    def begin(key: Any) -> Any:
        return environment.reset(key), jnp.float32(0.0)

    def step(carry: Any, action: Any) -> Any:
        state, reward, _ = environment.step(carry[0], action)
        return state, carry[1] + reward

    action = jax.ShapeDtypeStruct((SHIPPED[task].action_size,), jnp.float32)
    return Physics(begin, step, jax.eval_shape(begin, KEY), action)


def physics_functions(physics: Physics, target: Target, *, quick: bool = False) -> list[FunctionBuilder]:
    """Functions of the kernels

    begin(keys [4, lane], states [word, lane], lanes, 1)
    physics(states [word, lane], actions [step, word, lane], lanes, steps)
    """
    begin = function_of("reset", physics.begin, [("keys", KEY)], "states", target)
    given = [("states", physics.carry), ("actions", physics.action)]
    step = function_of("step", physics.step, given, "states", target, quick=quick)
    actions = Pointer("actions", words_of_step=words_in(physics.action))
    return [
        *begin,
        *step,
        lane_function("begin", [Pointer("keys"), Pointer("states")], [StepCall(begin[-1], ("keys", "states"))], target),
        lane_function("physics", [Pointer("states"), actions], [StepCall(step[-1], ("states", "actions"))], target),
    ]


def worker_spec(task: str) -> WorkerSpec:
    """A run of a shipped task with a policy of two hidden layers of HIDDEN units and action noise."""
    size = SHIPPED[task]
    return WorkerSpec(
        seed=0,
        environment=task,
        environment_options={},
        policy=PolicySpec((size.observation_size, HIDDEN, HIDDEN, size.action_size)),
        episode_steps=size.episode_steps,
        fitness="sum",
        episodes_per_member=1,
        observation_clip=5.0,
        action_noise=0.05,
        common_random_numbers=True,
        chunk_pairs=1,
        rollout_block_pairs=1,
        gradient_block_pairs=1,
        rollout="simd",
    )


def inputs_of(task: str) -> np.ndarray:
    """Indices of the observations that are not always zero."""
    return np.flatnonzero(~always_zero(make_environment(task, {})))


def episode_functions(task: str, target: Target, *, quick: bool = False) -> list[FunctionBuilder]:
    """Functions of the kernels of training episodes, of all lanes at a time:

    begin(keys [4, lane], carries [word, lane], lanes, 1)
    look(carries, constants [2 * input], seen [input, lane], lanes, 1)
    advance(carries, constants, actions [action, lane], action_keys [4, lane], seen, lanes, 1)

    constants are the means and standard deviations of the inputs. `advance` moves and looks again.
    """
    environment, spec, inputs_O = make_environment(task, {}), worker_spec(task), inputs_of(task)
    steps = episode_steps(environment, spec, training=True, inputs_O=inputs_O)
    reset = function_of("reset", steps.begin, [("keys", KEY)], "carries", target)
    calls = [StepCall(reset[-1], ("keys", "carries"))]
    return [
        *reset,
        lane_function("begin", [Pointer("keys"), Pointer("carries")], calls, target),
        *step_functions(environment, spec, inputs_O, target, quick=quick),
    ]


class PolicyLayout(NamedTuple):
    """Places of a policy's parameters in the memory of policy.cu."""

    noise: np.ndarray
    """Coordinate of each byte of a pair's noise; bytes that are never used have coordinate 0."""
    centre: np.ndarray
    """Coordinate of each float of the centre."""


def policy_layout(spec: PolicySpec, inputs_O: np.ndarray) -> PolicyLayout:
    """Layout of a policy with two hidden layers of HIDDEN units."""
    noise, centre, start, rows = [], [], 0, inputs_O
    for number, (inputs, outputs) in enumerate(spec.layers):
        weights = start + rows[:, None] * outputs + np.arange(outputs)
        biases = start + inputs * outputs + np.arange(outputs)
        if number + 1 < len(spec.layers):
            padded = np.concatenate([weights, np.zeros((-len(rows) % 4, outputs), weights.dtype)])
            noise.append(padded.reshape(-1, 4, outputs // 4, 4).transpose(0, 2, 1, 3))
        else:
            weights = weights.T
            noise.append(weights)
        noise.append(biases)
        centre += [weights, biases]
        start, rows = start + (inputs + 1) * outputs, np.arange(outputs)
    bytes_ = np.concatenate([indices.reshape(-1) for indices in noise])
    bytes_ = np.concatenate([bytes_, np.zeros(-len(bytes_) % 128, bytes_.dtype)])
    return PolicyLayout(bytes_.astype(np.uint32), np.concatenate([indices.reshape(-1) for indices in centre]))


def operations(a: Any, b: Any, c: Any, i: Any, j: Any) -> tuple[Any, ...]:
    """Every operation of graphs and the elementary functions, of three floats and two integers."""
    u, v = (lax.bitcast_convert_type(x, jnp.uint32) for x in (i, j))
    return (
        a + b, a - b, a * b, a / b, -a, jnp.abs(a), jnp.sqrt(a), jnp.floor(a), jnp.ceil(a), jnp.round(a),
        a == b, a != b, a < b, a <= b, jnp.where(a < b, a, c), a * b + c, c - a * b, a * b - c,
        i + j, i - j, i * j, i & j, i | j, i ^ j, i << 3, i >> 3, lax.shift_right_logical(i, 3), i == j, i < j, u < v,
        i.astype(jnp.float32), u.astype(jnp.float32), (a < b) ^ (b < c), lax.population_count(i),
        jnp.where(a < b, i, j), lax.bitcast_convert_type(i & 0x3FFFFFFF | 0x10000000, jnp.float32) * b,
        lax.div(i, j), lax.rem(i, j), lax.div(u, v), lax.rem(u, v), a.astype(jnp.int32),
        jnp.sin(a), jnp.cos(a), jnp.tan(a), jnp.arctan2(a, b), jnp.arcsin(a), jnp.arccos(a), jnp.exp(a), jnp.expm1(a),
        jnp.log(a), jnp.log1p(a), jnp.tanh(a), lax.logistic(a), lax.rsqrt(a), lax.rem(a, b), jnp.power(a, b),
    )  # fmt: skip


FIVE = (*[jax.ShapeDtypeStruct((), jnp.float32)] * 3, *[jax.ShapeDtypeStruct((), jnp.int32)] * 2)
"""Shapes and dtypes of the arguments of `operations`."""


def operation_functions(target: Target, *, quick: bool = False) -> list[FunctionBuilder]:
    """Functions of the kernel `operations(given [5, lane], found [word, lane], lanes, 1)`."""
    functions = function_of(
        "compute", operations, [("given", argument) for argument in FIVE], "found", target, quick=quick
    )
    pointers = [Pointer("given"), Pointer("found")]
    return [*functions, lane_function("operations", pointers, [StepCall(functions[-1], ("given", "found"))], target)]


def division_functions(target: Target) -> list[FunctionBuilder]:
    """Functions of the kernel `division(given [3, lane], found [2, lane], lanes, 1)`: a / b and the root of c."""
    functions = function_of(
        "divide",
        lambda a, b, c: (a / b, jnp.sqrt(c)),
        [("given", FIVE[0])] * 3,
        "found",
        target,
        quick=True,
    )
    pointers = [Pointer("given"), Pointer("found")]
    return [*functions, lane_function("division", pointers, [StepCall(functions[-1], ("given", "found"))], target)]


def operation_arguments() -> np.ndarray:
    """Words [5, lane] for `operations`: special values with each other, and random ones."""
    rng = np.random.default_rng(0)
    pool = np.array(
        [0.0, -0.0, 1.0, -1.0, 0.3, np.inf, -np.inf, np.nan, 1e-30, 3e38, 2.5, 8388609.0, 2.0**-126, 1e-20], np.float32
    )
    special = rng.choice(pool, (3, 2048))
    normal = (rng.normal(size=(3, 2048)) * 10.0 ** rng.integers(-6, 6, (3, 2048))).astype(np.float32)
    floats = np.concatenate([special, normal], axis=1)
    integers = rng.integers(0, 2**32, (2, 4096), dtype=np.uint32)
    integers[:, ::7] = rng.choice(np.array([0, 1, 2**31, 2**32 - 1], np.uint32), (2, len(integers[0, ::7])))
    return np.concatenate([floats.view(np.uint32), integers])
