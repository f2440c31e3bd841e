"""Programs of whole episodes: observation, policy, physics and sums from reset to end, one block of lanes at a time.

In training, the members of a pair are neighbouring lanes. The data of a block fits in the cache of a core: the noise of
its pairs (one byte per parameter), the centre, and the state of its episodes. In evaluations, all lanes have the
weights and the observation statistics of the centre, or with `per_lane_weights` each lane has its own.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.episodes import OF_STEPS
from es_service.protocol.messages import WorkerSpec
from es_service.protocol.noise import KEY_WORDS
from workers.environments import Environment
from workers.episode import Carry, EpisodeSteps, episode_steps
from workers.simd.backend.emit import graph_function
from workers.simd.backend.function_builder import FunctionBuilder, Names, module
from workers.simd.backend.native import words_of
from workers.simd.backend.target import Target
from workers.simd.episodes.hidden import Network, keep_function, plan
from workers.simd.episodes.low_rank import BlockNoise, plan_noise
from workers.simd.episodes.network import Weights, policy_function, singles_function
from workers.simd.episodes.noise_kernels import definition, fill_function
from workers.simd.frontend.trace import jaxpr_digest, trace_jaxpr
from workers.simd.graph.graph import Graph

Traced = tuple[Graph, int, list[int]]
"""A graph, the number of its input words, and the nodes of its outputs."""


class EpisodeProgram(NamedTuple):
    """The program of a run's episodes, before LLVM compiles it."""

    steps: EpisodeSteps
    carry: Carry
    """Shapes and dtypes of the state of an episode."""
    alive_word: int
    """Index of the word of a carry that says whether the episode is alive."""
    network: Network
    low_rank: BlockNoise | None
    """Layout of the noise of training episodes, if it has low rank."""
    of_steps: dict[str, range]
    """Words of a carry that have an output of each step, by its name."""
    name: str
    """Complete description of what the IR computes."""
    text: Callable[[], str]
    """Function that makes the LLVM IR. Raises UnsupportedError."""
    graphs: Callable[[], tuple[Traced, Traced]]
    """Function that gives the graphs of looking and of moving. Raises UnsupportedError."""


def write_episodes(
    environment: Environment,
    spec: WorkerSpec,
    inputs_O: np.ndarray,
    target: Target,
    *,
    training: bool,
    per_lane_weights: bool = False,
    finds_faults: bool = False,
) -> EpisodeProgram:
    """Program of a run's episodes for a target, which need not be this processor; `compile_episodes` compiles it.

    Raises:
        UnsupportedError: a step of the environment cannot be compiled. `text` of the result may raise it as well.
    """
    rank = spec.noise_rank if training else 0
    weights: Weights = "perturbed" if training and not rank else "per_lane" if per_lane_weights else "shared"
    steps = episode_steps(environment, spec, training=training, inputs_O=inputs_O, finds_faults=finds_faults)
    network = plan(spec.policy, inputs_O, target)
    low_rank = plan_noise(spec.policy, rank, inputs_O, network.hidden, target.width) if rank else None
    key, inputs = jax.ShapeDtypeStruct((KEY_WORDS,), jnp.uint32), jax.ShapeDtypeStruct((len(inputs_O),), jnp.float32)
    outputs = jax.ShapeDtypeStruct((spec.policy.outputs,), jnp.float32)
    carry = jax.eval_shape(steps.begin, key)
    normalised_observation, advance = (
        jax.make_jaxpr(steps.normalised_observation)(carry, inputs, inputs),
        jax.make_jaxpr(steps.advance)(carry, inputs, inputs, outputs, key),
    )
    leaves = jax.tree.leaves(carry)
    if [(aval.shape, aval.dtype) for aval in advance.out_avals] != [(aval.shape, aval.dtype) for aval in leaves]:
        raise TypeError(
            f"step returns a state of arrays {advance.out_avals}, but reset one of {leaves}; shapes and dtypes must "
            "agree"
        )
    alive_word = sum(words_of(aval) for aval in jax.tree.leaves(carry.state))
    words = sum(map(words_of, leaves))
    of_steps = {name: place for name, place in _places(carry).episode.outputs.items() if name in OF_STEPS}

    @functools.cache
    def graphs() -> tuple[Traced, Traced]:
        return trace_jaxpr(normalised_observation), trace_jaxpr(advance, lanes_word=alive_word)

    kept = [word for place in of_steps.values() for word in place]

    def text() -> str:
        return _module(*graphs(), network, low_rank, len(inputs_O), words, alive_word, weights, kept)

    digests = f"{definition()} {jaxpr_digest(normalised_observation)} {jaxpr_digest(advance)}"
    kind = f"{training}{' own' * per_lane_weights}{f' rank {rank}' if rank else ''}"
    name = f"episodes {digests} {spec.policy} {inputs_O.tolist()} {kind} {kept}"
    return EpisodeProgram(steps, carry, alive_word, network, low_rank, of_steps, name, text, graphs)


def _places(carry: Carry) -> Any:
    """The words of each array of a carry, in its place."""
    leaves, structure = jax.tree.flatten(carry)
    ends = list(accumulate(map(words_of, leaves), initial=0))
    return structure.unflatten([range(*place) for place in pairwise(ends)])


def _module(
    normalised_observation: Traced,
    advance: Traced,
    network: Network,
    low_rank: BlockNoise | None,
    inputs: int,
    words: int,
    alive_word: int,
    weights: Weights,
    kept: Sequence[int],
) -> str:
    """LLVM IR of whole episodes, the function

    void kernel(ptr carries, ptr action_keys, ptr constants, ptr centre, ptr keys, ptr places, ptr noise, ptr room,
                ptr kept, float unit, i64 blocks, i64 steps)

    With own weights, constants are those of each block, centre has the lanes' addresses, and noise is memory for the
    single weights of a block.

    Args:
        kept: words of a carry that are copied to `kept` [block, step, word, lane] after each step.
    """
    width, target = network.width, network.target
    actions = network.outputs
    graph, _, outputs = normalised_observation
    sources = [("carry", words), ("constants", inputs), ("constants", inputs)]
    observation_code = graph_function("look", graph, outputs, sources, "seen", target)
    graph, _, outputs = advance
    sources = [
        ("carry", words),
        ("constants", inputs),
        ("seen", inputs),
        ("action", actions),
        ("action_key", KEY_WORDS),
    ]
    advance_code = graph_function("move", graph, outputs, sources, "carry", target)
    policy_code = policy_function(network, weights, low_rank)
    per_lane, noisy, keeps = weights == "per_lane", weights == "perturbed" or low_rank is not None, False
    before = [singles_function(network)] if per_lane else []
    if noisy:
        layout = low_rank or network
        before.append(fill_function(layout.vectors, len(layout.places) - layout.vectors, target))
        if keeps := low_rank is None and network.keeps_weights:
            before.append(keep_function(network))

    pointers = ["carries", "action_keys", "constants", "centre", "keys", "places", "noise", "room", "kept"]
    builder = FunctionBuilder(
        "inside", [*(f"ptr noalias %{name}" for name in pointers), "float %unit", "i64 %blocks", "i64 %steps"], target
    )
    vector = builder.llvm_types["i"]
    seen, action = "%room", builder.at("%room", inputs, vector)
    hidden = builder.at("%room", inputs + actions, vector)

    def block(number: str, _: Names) -> Names:
        carry = builder.at("%carries", builder.index((number, words)), vector)
        action_key = builder.at("%action_keys", builder.index((number, KEY_WORDS)), vector)
        alive = builder.at(carry, alive_word, vector)
        constants = builder.at("%constants", builder.index((number, 2 * inputs)), vector) if per_lane else "%constants"
        policies = builder.at("%centre", builder.index((number, width)), "i64") if per_lane else "%centre"
        given = "ptr %places, ptr %noise, " if per_lane else "ptr %noise, float %unit, " if noisy else ""
        if per_lane:
            builder.do(f"call void @singles(ptr {policies}, ptr %places, ptr %noise)")
        if noisy:
            keys = builder.at("%keys", builder.index((number, KEY_WORDS * width // 2)), "i32")
            builder.do(f"call void @fill(ptr {keys}, ptr %places, ptr %noise)")
            if keeps:
                builder.do("call void @keep(ptr %centre, ptr %noise, float %unit)")

        def keep(number_of_step: str) -> None:
            row = builder.value(f"add i64 {builder.value(f'mul i64 {number}, %steps')}, {number_of_step}")
            copies = builder.at("%kept", builder.index((row, len(kept))), vector)
            for place, word in enumerate(kept):
                builder.store(vector, builder.load(vector, carry, word), copies, place)

        def step(number_of_step: str, _: Names) -> Names:
            builder.do(f"call void @look(ptr {carry}, ptr {constants}, ptr {seen})")
            builder.do(f"call void @policy(ptr {seen}, ptr {alive}, ptr {policies}, {given}ptr {hidden}, ptr {action})")
            builder.do(f"call void @move(ptr {carry}, ptr {constants}, ptr {seen}, ptr {action}, ptr {action_key})")
            if kept:
                keep(number_of_step)
            return []

        def all_done() -> str:
            return builder.value(f"xor i1 {builder.any(builder.load(vector, alive))}, true")

        builder.loop("%steps", step, until=all_done)
        return []

    builder.loop("%blocks", block)
    return module([observation_code, advance_code, policy_code, *before, builder])
