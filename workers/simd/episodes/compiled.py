"""Compiled episodes: the program of `program.py` as a function that workers call.

In training, the members of a pair are neighbouring lanes. In evaluations, all lanes have the weights and the
observation statistics of the centre, or with `per_lane_weights` each lane has its own.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from es_service.protocol.messages import EVALUATION_EPISODES_PER_CHUNK, WorkerSpec
from es_service.protocol.noise import KEY_WORDS
from workers.compiling import Compilable
from workers.environments import Environment
from workers.episode import Carry
from workers.rollouts.backend import Episodes, no_faults
from workers.simd.backend.native import (
    ALIGNMENT,
    Native,
    Words,
    aligned,
    filled,
    load_compiled,
    pack,
    require,
    unpack,
    words_of,
)
from workers.simd.backend.target import Target, host_target
from workers.simd.episodes.hidden import Network
from workers.simd.episodes.kernel import Check, compile_resets, no_check
from workers.simd.episodes.low_rank import BlockNoise
from workers.simd.episodes.program import EpisodeProgram, write_episodes


@dataclass(frozen=True)
class EpisodeKernel:
    """Compiled episodes: training episodes of both members of pairs, or evaluation episodes of the centre or, with
    `per_lane_weights`, of a policy in each lane."""

    training: bool
    per_lane_weights: bool
    spec: WorkerSpec
    inputs_O: np.ndarray
    """Indices of the observations that are computed, as inputs of the policy."""
    network: Network
    low_rank: BlockNoise | None
    """Layout of the noise of training episodes, if it has low rank."""
    begin: Compilable
    """Function from reset keys [lane, 4] to words of carries [block, word, lane]."""
    alive_word: int
    """Index of the word of a carry that says whether the episode is alive."""
    carry: Carry
    """Shapes and dtypes of a carry."""
    episode_words: int
    finite_words: int
    """Number of words, the first of these, that are finite in an episode without a fault."""
    of_steps: dict[str, range]
    """Words of a carry that have an output of each step, by its name."""
    _call: Callable[..., None]

    def run(
        self,
        weights: np.ndarray,
        unit: float,
        mean_O: np.ndarray,
        std_O: np.ndarray,
        noise_keys_P: np.ndarray | None,
        reset_keys_L: np.ndarray,
        action_keys_L: np.ndarray,
        wanted_L: np.ndarray | None = None,
    ) -> Episodes:
        """Run the episodes of all lanes, [L]; returns NumPy arrays.

        Args:
            weights: the centre, packed by `network.pack`; with own weights the uint64 address of each lane's float32
                parameters, in memory that goes on for at least a vector behind them.
            unit: sigma / NORMAL_STD.
            mean_O, std_O: observation statistics; with own weights those of each lane, [L, O].
            noise_keys_P: keys of the pairs' noise; None for evaluations.
            reset_keys_L, action_keys_L: stream keys of each lane's reset and action noise.
            wanted_L: lanes whose episodes are run, all if None; a block of lanes ends when these are done. The others
                stay at their reset.
        """
        lanes = len(reset_keys_L)
        steps = self.spec.episode_steps
        kept = self._room_for_steps(-(-lanes // self.network.width), steps)
        carries, go = self.started(weights, unit, mean_O, std_O, noise_keys_P, reset_keys_L, action_keys_L, kept)
        if wanted_L is not None:
            require(wanted_L.shape == (lanes,) and wanted_L.dtype == bool, "wanted_L must have a bool for each lane")
            lane_L = np.flatnonzero(~wanted_L)
            carries[lane_L // self.network.width, self.alive_word, lane_L % self.network.width] = 0
        go(steps)
        return self.results(carries[:, -self.episode_words :], lanes).with_steps(self._steps_kept(kept, lanes))

    def results(self, words: Words, lanes: int) -> Episodes:
        """The results of episodes, [L], of the last words of their carries, [block, word, lane].

        A kernel that finds no faults only leaves a trace of them, a result that is not finite, for other reasons too.
        `Episodes.fault` says that there are none then; it is None if all results are finite.
        """
        leaves, structure = jax.tree.flatten(self.carry.episode)
        episodes = structure.unflatten(unpack(words, leaves, lanes))
        if episodes.fault is None and not _all_finite(words[:, : self.finite_words]):
            episodes = episodes._replace(fault=no_faults(lanes))
        if not self.training or len(self.inputs_O) == self.spec.policy.widths[0]:
            return episodes
        sums = [np.zeros((lanes, self.spec.policy.widths[0]), np.float32) for _ in range(2)]
        sums[0][:, self.inputs_O], sums[1][:, self.inputs_O] = episodes.shifted_sum_O, episodes.shifted_square_sum_O
        return episodes._replace(shifted_sum_O=sums[0], shifted_square_sum_O=sums[1])

    def _room_for_steps(self, blocks: int, steps: int) -> Words:
        """Memory for the outputs of each step: [block, step, word, lane]."""
        return aligned((blocks, steps, sum(map(len, self.of_steps.values())), self.network.width))

    def _steps_kept(self, kept: Words, lanes: int) -> dict[str, np.ndarray]:
        """The outputs of each step by name, [lane, step, ...]."""
        outputs, end = {}, 0
        for name, place in self.of_steps.items():
            start, end = end, end + len(place)
            output, steps = self.carry.episode.outputs[name], kept.shape[1]
            words = kept[:, :, start:end].reshape(len(kept), steps * len(place), -1)
            (outputs[name],) = unpack(words, [jax.ShapeDtypeStruct((steps, *output.shape), output.dtype)], lanes)
        return outputs

    def watch(self, weights: np.ndarray, mean_O: np.ndarray, std_O: np.ndarray, reset_key: np.ndarray) -> Carry:
        """Run one evaluation episode step by step; returns its carries until it is done, with leading axis [T]."""
        carries, go = self.started(weights, 0.0, mean_O, std_O, None, reset_key[None], reset_key[None])
        words = [carries[0, :, 0].copy()]
        while carries[0, self.alive_word, 0] and len(words) <= self.spec.episode_steps:
            go(1)
            words.append(carries[0, :, 0].copy())
        leaves, structure = jax.tree.flatten(self.carry)
        return structure.unflatten(unpack(np.stack(words, axis=1)[None], leaves, len(words)))

    def started(
        self,
        weights: np.ndarray,
        unit: float,
        mean_O: np.ndarray,
        std_O: np.ndarray,
        noise_keys_P: np.ndarray | None,
        reset_keys_L: np.ndarray,
        action_keys_L: np.ndarray,
        kept: Words | None = None,
    ) -> tuple[np.ndarray, Callable[[int], None]]:
        """Words of the carries after the reset [block, word, lane], and a function that runs so many more steps.

        Args:
            kept: memory for the outputs of as many steps as the function runs, which begin anew at each call; None:
                they are not wanted.
        """
        width, lanes = self.network.width, len(reset_keys_L)
        require(
            (noise_keys_P is not None) == self.training
            and action_keys_L.shape == reset_keys_L.shape == (lanes, KEY_WORDS)
            and (noise_keys_P is None or (noise_keys_P.shape[1:] == (KEY_WORDS,) and 2 * len(noise_keys_P) >= lanes)),
            "there must be keys for each lane, and in training for each pair",
        )
        carries = self.begin(reset_keys_L)
        blocks = len(carries)
        carries[-1, self.alive_word, lanes - width * (blocks - 1) :] = 0  # lanes without an episode
        actions = pack([action_keys_L], width)
        statistics = [x[..., self.inputs_O].reshape(-1, len(self.inputs_O)).astype(np.float32) for x in (mean_O, std_O)]
        constants = pack(statistics, width)
        ranks = self.low_rank.rank if self.low_rank else 0
        room = aligned((len(self.inputs_O) + self.network.outputs + self.network.hidden_vectors + ranks, width))
        keys, noise = np.zeros((0, KEY_WORDS), np.uint32), np.zeros(0, np.int8)
        if self.per_lane_weights:
            require(len(statistics[0]) == len(weights) == lanes, "each lane must have weights and statistics")
            weights = filled(weights, blocks * width)
            noise = aligned((len(self.network.places) - self.network.vectors, width)).view(np.int8)  # single weights
        else:
            whole = weights.ctypes.data % ALIGNMENT == 0 and weights.shape == (self.network.rows, width)
            require(whole and len(constants) == 1, "the centre must be packed and have one mean and standard deviation")
        if noise_keys_P is not None:
            pairs = width // 2
            keys = filled(noise_keys_P, blocks * pairs)
            size = self.low_rank.block_bytes(width) if self.low_rank else self.network.block_bytes
            noise = aligned((-(-size // 4),)).view(np.int8)
        places = (self.low_rank or self.network).places
        arrays = (carries, actions, constants, weights, keys, places, noise, room)
        require(
            [array.dtype.char for array in arrays] == list("IIILIIbI" if self.per_lane_weights else "IIIfIIbI")
            and all(array.flags.c_contiguous for array in arrays),
            "they must be contiguous and have the dtypes of the kernel",
        )

        def go(steps: int) -> None:
            steps_kept = self._room_for_steps(blocks, steps) if kept is None else kept
            require(steps_kept.shape[:2] == (blocks, steps), "there is no room for the outputs of these steps")
            self._call(*arrays, steps_kept, np.float32(unit), blocks, steps)

        return carries, go


def _all_finite(words: Words) -> bool:
    return np.count_nonzero(np.isfinite(words.view(np.float32))) == words.size  # in half the time of `all`


def compile_episodes(
    environment: Environment,
    spec: WorkerSpec,
    inputs_O: np.ndarray,
    *,
    training: bool,
    per_lane_weights: bool = False,
    finds_faults: bool = False,
    target: Target | None = None,
    folder: Path | None = None,
    check: Callable[[EpisodeKernel, EpisodeProgram], object] = lambda kernel, program: None,
    check_resets: Check = no_check,
) -> EpisodeKernel:
    """Compile the episodes of a run.

    Args:
        inputs_O: indices of the observations that are computed; others are always zero.
        training: training episodes, or else evaluation episodes.
        per_lane_weights: evaluation episodes of a policy in each lane, instead of those of the centre.
        finds_faults: see `workers.episode.episode_steps`.
        target: processor and instruction set; the widest vectors of this machine if None.
        folder: folder of the cache; the user's cache if None.
        check, check_resets: functions that raise an exception if new code is wrong; see check.py.

    Raises:
        UnsupportedError: a step of the environment cannot be compiled.
        NoVectorsError: this processor lacks the vector instructions.
    """
    target = target or host_target()
    kind = {"training": training, "per_lane_weights": per_lane_weights, "finds_faults": finds_faults}
    program = write_episodes(environment, spec, inputs_O, target, **kind)
    lanes = 2 * spec.chunk_pairs if training else EVALUATION_EPISODES_PER_CHUNK
    begin = compile_resets(
        program.steps.begin, target, folder, lanes, check_resets, may_draw=environment.compiles_drawn_resets
    )
    episode = program.carry.episode
    signature = [*[ctypes.c_void_p] * 9, ctypes.c_float, ctypes.c_int64, ctypes.c_int64]

    def kernel(native: Native) -> EpisodeKernel:
        return EpisodeKernel(
            training=training,
            per_lane_weights=per_lane_weights,
            spec=spec,
            inputs_O=inputs_O,
            network=program.network,
            low_rank=program.low_rank,
            begin=begin,
            alive_word=program.alive_word,
            of_steps=program.of_steps,
            carry=program.carry,
            episode_words=sum(map(words_of, jax.tree.leaves(episode))),
            finite_words=sum(map(words_of, episode[: Episodes._fields.index("goal_distance")])),
            _call=native.function(*signature),
        )

    return kernel(
        load_compiled(program.name, program.text, target, folder, lambda native: check(kernel(native), program))
    )
