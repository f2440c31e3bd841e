"""A run's training episodes as PTX: noise, the policy's layers, and control steps, each a kernel of its own.

    fill(keys [pair, 4], places [row, TILE], noises, pairs, threads)      `network.py`, once per episode
    look(carries [word, lane], constants [2 * input], seen [input, lane], lanes, 1)
    layer_1(seen, noises, centre, out, unit, pairs, threads), layer_2 ...
    advance(carries, constants, actions [action, lane], action_keys [4, lane], seen, lanes, 1)

A lane is a member. `advance` moves and looks again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.messages import WorkerSpec
from es_service.protocol.noise import KEY_WORDS
from workers.environments import Environment
from workers.episode import episode_steps
from workers.simd.backend.emit import graph_function
from workers.simd.backend.function_builder import FunctionBuilder
from workers.simd.backend.ptx import Call, Pointer, lane_function
from workers.simd.backend.quick_division import EXACT, QuickWriter
from workers.simd.backend.target import Target
from workers.simd.backend.words import words_of
from workers.simd.frontend.trace import trace_jaxpr
from workers.simd.gpu.network import TILE, fill_function, layer_function, layers_of, noise_bytes

KEY = jax.ShapeDtypeStruct((KEY_WORDS,), jnp.uint32)


def function_of(
    name: str,
    function: Callable[..., Any],
    arguments: Sequence[tuple[str, Any]],
    out: str,
    target: Target,
    shared: Sequence[str] = (),
    *,
    quick: bool = False,
    lanes_word: int | None = None,
) -> list[FunctionBuilder]:
    """Function `void name(ptr ..., i64 lanes)` of a JAX function, and functions that it calls; it is the last one.

    Args:
        arguments: (pointer, shapes and dtypes) of each of its arguments. A pointer may occur twice.
        out: pointer to the words of the result.
        shared: pointers whose words are neighbours. If all are, there is no parameter `lanes`.
        quick: whether quotients and roots are those of `quick_division.py`.
        lanes_word: see `trace_jaxpr`.
    """
    closed = jax.make_jaxpr(function)(*(tree for _, tree in arguments))
    graph, _, outputs = trace_jaxpr(closed, lanes_word=lanes_word)
    sources = [(pointer, words_in(tree)) for pointer, tree in arguments]
    apart = sorted({*(pointer for pointer, _ in arguments), out} - set(shared))
    exact = graph_function(name + EXACT * quick, graph, outputs, sources, out, target, apart)
    if not quick:
        return [exact]
    return [exact, graph_function(name, graph, outputs, sources, out, target, apart, QuickWriter)]


def words_in(tree: Any) -> int:
    """Words of one lane of a pytree of arrays."""
    return sum(map(words_of, jax.tree.leaves(tree)))


def noise_functions(target: Target) -> list[FunctionBuilder]:
    """Functions of the kernel `fill`."""
    places = jax.ShapeDtypeStruct((TILE,), jnp.uint32)
    given = [("keys", KEY), ("places", places)]
    noise = function_of("noise", noise_bytes, given, "noises", target, ["keys", "places", "noises"])
    return [*noise, fill_function(noise[-1], target)]


def episode_functions(
    environment: Environment, spec: WorkerSpec, inputs_O: np.ndarray, target: Target
) -> list[FunctionBuilder]:
    """Functions of the kernels of a run's training episodes.

    Args:
        inputs_O: indices of the observations that are computed; others are always zero.
    """
    return [
        *noise_functions(target),
        *(layer_function(layer, target) for layer in layers_of(spec.policy, inputs_O)[0]),
        *step_functions(environment, spec, inputs_O, target, quick=True),
    ]


def step_functions(
    environment: Environment, spec: WorkerSpec, inputs_O: np.ndarray, target: Target, *, quick: bool
) -> list[FunctionBuilder]:
    """Functions of the kernels `look` and `advance`, with arguments as `episode_functions` and `function_of`."""
    steps = episode_steps(environment, spec, training=True, inputs_O=inputs_O, finds_faults=False)
    carry = jax.eval_shape(steps.begin, KEY)
    inputs, outputs = (jax.ShapeDtypeStruct((size,), jnp.float32) for size in (len(inputs_O), spec.policy.outputs))
    of_carry, of_constants = ("carries", carry), ("constants", inputs)
    see = function_of(
        "see", steps.normalised_observation, [of_carry, of_constants, of_constants], "seen", target, ["constants"]
    )
    given = [of_carry, of_constants, ("seen", inputs), ("actions", outputs), ("action_keys", KEY)]
    alive = words_in(carry.state)
    move = function_of("move", steps.advance, given, "carries", target, ["constants"], quick=quick, lanes_word=alive)
    carries, constants, seen = Pointer("carries"), Pointer("constants", by_lane=False), Pointer("seen")
    sees = Call(see[-1], ("carries", "constants", "seen"))
    moves = Call(move[-1], ("carries", "constants", "seen", "actions", "action_keys"))
    of_move = [carries, constants, Pointer("actions"), Pointer("action_keys"), seen]
    return [
        *see,
        *move,
        lane_function("look", [carries, constants, seen], [sees], target),
        lane_function("advance", of_move, [moves, sees], target),
    ]
