"""Kernels of whole episodes: observation, policy, physics and sums from reset to end, one block of lanes at a time.

The members of a pair are neighbouring lanes. The data of a block fits in the cache of a core: the noise of its pairs
(one byte per parameter), the centre, and the state of its episodes.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr

from es_service.protocol.messages import WorkerSpec
from es_service.protocol.noise import KEY_WORDS
from workers.environments import Environment
from workers.episode import Carry, Episodes, EpisodeSteps, episode_steps
from workers.simd.backend.emit import graph_function
from workers.simd.backend.function_builder import FunctionBuilder, Values, module
from workers.simd.backend.native import load_compiled
from workers.simd.backend.target import Target, host_target
from workers.simd.backend.words import ALIGNMENT, aligned, filled, pack, unpack, words_of
from workers.simd.episodes.kernel import Kernel, compile_kernel
from workers.simd.episodes.layout import Network, plan
from workers.simd.episodes.network import policy_function
from workers.simd.episodes.noise import definition, fill_function
from workers.simd.frontend.digest import jaxpr_digest
from workers.simd.frontend.trace import trace_jaxpr
from workers.simd.graph.unsupported import UnsupportedError


@dataclass(frozen=True)
class EpisodeKernel:
    """Compiled episodes, either training episodes of both members of pairs or evaluation episodes of the centre."""

    training: bool
    spec: WorkerSpec
    inputs_O: np.ndarray
    """Indices of the observations that are computed, as inputs of the policy."""
    network: Network
    begin: Callable[[np.ndarray], np.ndarray]
    """Function from reset keys [lane, 4] to words of carries [block, word, lane]."""
    alive_word: int
    """Index of the word of a carry that says whether the episode is alive."""
    carry: Carry
    """Shapes and dtypes of a carry."""
    episode_words: int
    """Number of words of an episode's result."""
    _call: Callable[..., None]
    _alive: Any

    def run(
        self,
        weights: np.ndarray,
        unit: float,
        mean_O: np.ndarray,
        std_O: np.ndarray,
        noise_keys_P: np.ndarray | None,
        reset_keys_L: np.ndarray,
        action_keys_L: np.ndarray,
    ) -> Episodes:
        """Run the episodes of all lanes, [L]; returns NumPy arrays.

        Args:
            weights: the centre, packed by `network.pack`.
            unit: sigma / NORMAL_STD.
            noise_keys_P: keys of the pairs' noise; None for evaluations.
            reset_keys_L, action_keys_L: stream keys of each lane's reset and action noise.
        """
        lanes = len(reset_keys_L)
        carries, go = self._begun(weights, unit, mean_O, std_O, noise_keys_P, reset_keys_L, action_keys_L)
        go(self.spec.episode_steps)
        # The result of an episode is the last part of a carry.
        found = Episodes(*unpack(carries[:, -self.episode_words :], self.carry.episode, lanes))
        if not self.training or len(self.inputs_O) == self.spec.policy.widths[0]:
            return found
        sums = [np.zeros((lanes, self.spec.policy.widths[0]), np.float32) for _ in range(2)]
        sums[0][:, self.inputs_O], sums[1][:, self.inputs_O] = found.shifted_sum_O, found.shifted_square_sum_O
        return found._replace(shifted_sum_O=sums[0], shifted_square_sum_O=sums[1])

    def watch(self, weights: np.ndarray, mean_O: np.ndarray, std_O: np.ndarray, reset_key: np.ndarray) -> Carry:
        """Run one evaluation episode step by step; returns its carries until it is done, with leading axis [T]."""
        carries, go = self._begun(weights, 0.0, mean_O, std_O, None, reset_key[None], reset_key[None])
        words = [carries[0, :, 0].copy()]
        while carries[0, self.alive_word, 0] and len(words) <= self.spec.episode_steps:
            go(1)
            words.append(carries[0, :, 0].copy())
        leaves, structure = jax.tree.flatten(self.carry)
        return structure.unflatten(unpack(np.stack(words, axis=1)[None], leaves, len(words)))

    def _begun(
        self,
        weights: np.ndarray,
        unit: float,
        mean_O: np.ndarray,
        std_O: np.ndarray,
        noise_keys_P: np.ndarray | None,
        reset_keys_L: np.ndarray,
        action_keys_L: np.ndarray,
    ) -> tuple[np.ndarray, Callable[[int], None]]:
        """Words of the carries after the reset [block, word, lane], and a function that runs so many more steps."""
        width, lanes = self.network.width, len(reset_keys_L)
        # Native code would read beyond the end of a shorter array without an error.
        assert (noise_keys_P is not None) == self.training
        assert action_keys_L.shape == reset_keys_L.shape == (lanes, KEY_WORDS)
        assert noise_keys_P is None or (noise_keys_P.shape[1:] == (KEY_WORDS,) and 2 * len(noise_keys_P) >= lanes)
        carries = self.begin(reset_keys_L)
        blocks = len(carries)
        carries[-1, self.alive_word, lanes - width * (blocks - 1) :] = 0  # lanes without an episode
        actions = pack([action_keys_L], width)
        constants = np.concatenate([mean_O[self.inputs_O], std_O[self.inputs_O]]).astype(np.float32)
        seen_and_done = len(self.inputs_O) + self.network.outputs
        memory = aligned((len(constants) + seen_and_done + self.network.hidden_vectors, width))
        splats, room = memory[: len(constants)], memory[len(constants) :]
        splats[:] = constants.view(np.uint32)[:, None]
        keys, noise = np.zeros((0, KEY_WORDS), np.uint32), np.zeros(0, np.int8)
        if noise_keys_P is not None:
            pairs = width // 2
            keys = filled(noise_keys_P, blocks * pairs)
            noise = np.empty(self.network.noise_bytes, np.int8)
        arrays = (carries, actions, splats, weights, keys, self.network.places, noise, room)
        assert [array.dtype.char for array in arrays] == list("IIIfIIbI")
        assert all(array.flags.c_contiguous for array in arrays)
        assert weights.ctypes.data % ALIGNMENT == 0
        assert weights.shape == (self.network.rows, width)
        pointers = [array.ctypes.data for array in arrays]

        def go(steps: int) -> None:
            assert all(array is not None for array in arrays)  # their memory must live as long as this function
            self._call(*pointers, np.float32(unit), blocks, steps)

        return carries, go


def compile_episodes(
    environment: Environment,
    spec: WorkerSpec,
    inputs_O: np.ndarray,
    *,
    training: bool,
    target: Target | None = None,
    folder: Path | None = None,
) -> EpisodeKernel:
    """Compile the episodes of a run.

    Args:
        inputs_O: indices of the observations that are computed; others are always zero.
        training: training episodes, or else evaluation episodes.
        target: processor and instruction set; the widest vectors of this machine if None.
        folder: folder of the cache; the user's cache if None.

    Raises:
        UnsupportedError: a step of the environment cannot be compiled.
        NoVectorsError: this processor lacks the vector instructions.
    """
    target = target or host_target()
    program = write_episodes(environment, spec, inputs_O, target.width, training=training)
    native = load_compiled(program.name, program.text, target, folder)
    signature = [*[ctypes.c_void_p] * 8, ctypes.c_float, ctypes.c_int64, ctypes.c_int64]
    carry = program.carry
    return EpisodeKernel(
        training=training,
        spec=spec,
        inputs_O=inputs_O,
        network=program.network,
        begin=_begin(program.steps, target, folder),
        alive_word=program.alive_word,
        carry=carry,
        episode_words=sum(map(words_of, carry.episode)),
        _call=ctypes.CFUNCTYPE(None, *signature)(native.address),
        _alive=native.alive,
    )


class EpisodeProgram(NamedTuple):
    """The program of a run's episodes, before LLVM compiles it."""

    steps: EpisodeSteps
    carry: Carry
    """Shapes and dtypes of the state of an episode."""
    alive_word: int
    """Index of the word of a carry that says whether the episode is alive."""
    network: Network
    name: str
    """Complete description of what the IR computes."""
    text: Callable[[], str]
    """Function that makes the LLVM IR. Raises UnsupportedError."""


def write_episodes(
    environment: Environment, spec: WorkerSpec, inputs_O: np.ndarray, width: int, *, training: bool
) -> EpisodeProgram:
    """Program of a run's episodes for vectors of `width` lanes, for any processor; `compile_episodes` compiles it.

    Raises:
        UnsupportedError: a step of the environment cannot be compiled. `text` of the result may raise it as well.
    """
    steps = episode_steps(environment, spec, training=training, inputs_O=inputs_O)
    network = plan(spec.policy, inputs_O, width)
    key, inputs = jax.ShapeDtypeStruct((KEY_WORDS,), jnp.uint32), jax.ShapeDtypeStruct((len(inputs_O),), jnp.float32)
    action = jax.ShapeDtypeStruct((spec.policy.widths[-1],), jnp.float32)
    carry = jax.eval_shape(steps.begin, key)
    look, move = (
        jax.make_jaxpr(steps.look)(carry, inputs, inputs),
        jax.make_jaxpr(steps.move)(carry, inputs, action, key),
    )
    leaves = jax.tree.leaves(carry)
    if [(aval.shape, aval.dtype) for aval in move.out_avals] != [(aval.shape, aval.dtype) for aval in leaves]:
        raise TypeError(
            f"step returns a state of arrays {move.out_avals}, but reset one of {leaves}; shapes and dtypes must agree"
        )
    alive_word = sum(words_of(aval) for aval in jax.tree.leaves(carry.state))
    words = sum(map(words_of, leaves))

    def text() -> str:
        return _module(look, move, network, len(inputs_O), words, alive_word, training=training)

    digests = f"{definition()} {jaxpr_digest(look)} {jaxpr_digest(move)}"
    name = f"episodes {digests} {spec.policy} {inputs_O.tolist()} {training}"
    return EpisodeProgram(steps, carry, alive_word, network, name, text)


def _begin(steps: EpisodeSteps, target: Target, folder: Path | None) -> Callable[[np.ndarray], np.ndarray]:
    """Function that resets environments, compiled by simd if possible and otherwise by JAX.

    Resets of Brax's own environments, for example, cannot be compiled by simd. Resets are few compared with steps, but
    the bits of those that JAX compiles may differ between processors.
    """
    key = jax.ShapeDtypeStruct((KEY_WORDS,), jnp.uint32)
    try:
        kernel: Kernel = compile_kernel(steps.begin, key, target=target, folder=folder)
    except UnsupportedError:
        resets = jax.jit(jax.vmap(steps.begin))
        return lambda keys_L: pack([np.asarray(leaf) for leaf in jax.tree.leaves(resets(keys_L))], target.width)

    def begin(keys_L: np.ndarray) -> np.ndarray:
        keys = pack([keys_L], target.width)
        out = aligned((len(keys), kernel.words_out, target.width))
        kernel.run(keys, out)
        return out

    return begin


def _module(
    look: ClosedJaxpr, move: ClosedJaxpr, network: Network, inputs: int, words: int, alive_word: int, *, training: bool
) -> str:
    """LLVM IR of whole episodes, the function

    void kernel(ptr carries, ptr action_keys, ptr constants, ptr centre, ptr keys, ptr places, ptr noise, ptr room,
                float unit, i64 blocks, i64 steps)
    """
    width = network.width
    actions = network.outputs
    graph, _, outputs = trace_jaxpr(look)
    sources = [("carry", words), ("constants", inputs), ("constants", inputs)]
    look_code = graph_function("look", graph, outputs, sources, "seen", width)
    graph, _, outputs = trace_jaxpr(move)
    sources = [("carry", words), ("constants", inputs), ("action", actions), ("action_key", KEY_WORDS)]
    move_code = graph_function("move", graph, outputs, sources, "carry", width)
    policy_code = policy_function(network, noisy=training)
    fill_code = fill_function(network.vectors, len(network.places) - network.vectors, width)

    pointers = ["carries", "action_keys", "constants", "centre", "keys", "places", "noise", "room"]
    builder = FunctionBuilder(
        "inside", [*(f"ptr noalias %{name}" for name in pointers), "float %unit", "i64 %blocks", "i64 %steps"], width
    )
    vector = builder.llvm_types["i"]
    seen, action = "%room", builder.at("%room", inputs, vector)
    hidden = builder.at("%room", inputs + actions, vector)

    def block(number: str, _: Values) -> Values:
        carry = builder.at("%carries", builder.index((number, words)), vector)
        action_key = builder.at("%action_keys", builder.index((number, KEY_WORDS)), vector)
        alive = builder.at(carry, alive_word, vector)
        if training:
            keys = builder.at("%keys", builder.index((number, KEY_WORDS * width // 2)), "i32")
            builder.do(f"call void @fill(ptr {keys}, ptr %places, ptr %noise)")

        def step(_: str, __: Values) -> Values:
            builder.do(f"call void @look(ptr {carry}, ptr %constants, ptr {seen})")
            noise = "ptr %noise, float %unit, " if training else ""
            builder.do(f"call void @policy(ptr {seen}, ptr {alive}, ptr %centre, {noise}ptr {hidden}, ptr {action})")
            builder.do(f"call void @move(ptr {carry}, ptr %constants, ptr {action}, ptr {action_key})")
            return []

        def all_done() -> str:
            return builder.value(f"xor i1 {builder.any(builder.load(vector, alive))}, true")

        builder.loop("%steps", step, until=all_done)
        return []

    builder.loop("%blocks", block)
    return module([look_code, move_code, policy_code, *([fill_code] if training else []), builder])
