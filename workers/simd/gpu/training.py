"""Training episodes on the GPU of this process, with the bits of `episodes/compiled.py`; evaluations and gradients stay
on the processor, whose results are the same."""

from __future__ import annotations

import threading
from ctypes import c_float, c_int64
from typing import Any, NamedTuple

import jax
import numpy as np

from es_service.protocol.messages import WorkerSpec
from es_service.protocol.noise import Keys
from workers.compiling import Compilable
from workers.environments import Environment
from workers.rollouts.backend import Episodes
from workers.simd.backend.native import require_same
from workers.simd.episodes.compiled import EpisodeKernel
from workers.simd.gpu.cuda import Gpu, GpuArray, Module, the_gpu
from workers.simd.gpu.program import TILE, GpuLayer, episode_functions, layers_of

STEPS_BETWEEN_LOOKS = 25
"""Control steps after which the processor looks whether any episode goes on; it costs some tens of microseconds."""
CHECKED = 8
"""Pairs whose episodes are compared with those of the processor, when code is new to this process."""


class _GpuMemory(NamedTuple):
    noises: GpuArray
    seen: GpuArray
    hidden: tuple[GpuArray, GpuArray]
    """Outputs of the layers, which take turns."""


class _Program(NamedTuple):
    """Kernels for a choice of inputs."""

    module: Module
    layers: tuple[GpuLayer, ...]
    places: np.ndarray
    on_gpu: GpuArray


def episodes_on_gpu(environment: Environment, spec: WorkerSpec, gpu: Gpu | None = None) -> Compilable:
    """Function that runs training episodes on a GPU, as `make_training_rollout` takes it.

    Args:
        gpu: None for that of this process.

    Raises GpuError as `Gpu`.
    """
    episodes = GpuEpisodes(environment, spec, gpu or the_gpu())
    return Compilable(episodes.run, lambda kernel: episodes.program(kernel.inputs_O))


class GpuEpisodes:
    """Runs the training episodes of a run. Threads take turns."""

    def __init__(self, environment: Environment, spec: WorkerSpec, gpu: Gpu) -> None:
        """Prepare them; kernels are compiled when they are needed."""
        self._environment, self._spec, self._gpu = environment, spec, gpu
        self._programs: dict[bytes, _Program] = {}
        self._rooms: dict[tuple[bytes, int], _GpuMemory] = {}
        self._checked: set[bytes] = set()
        """Programs whose results have been compared with those of the processor."""
        self._lock = threading.RLock()

    def program(self, inputs_O: np.ndarray) -> _Program:
        """The kernels for a choice of inputs, compiled at the first call. Raises GpuError as `Gpu.module`."""
        key = inputs_O.tobytes()
        with self._lock:
            self._gpu.enter()
            if key not in self._programs:
                layers, places = layers_of(self._spec.policy, inputs_O)
                functions = episode_functions(self._environment, self._spec, inputs_O, self._gpu.target)
                self._programs[key] = _Program(self._gpu.module(functions), layers, places, self._gpu.copied(places))
            return self._programs[key]

    def run(self, kernel: EpisodeKernel, centre_D: np.ndarray, unit: float, *given: Any) -> Episodes:
        """Episodes [L] of both members of each pair, with the bits of a kernel.

        Args:
            given: mean_O, std_O, noise_keys_P, reset_keys_L, action_keys_L, as for `EpisodeKernel.run`.

        Raises WrongCodeError if new code does not compute the first episodes as the processor does.
        """
        with self._lock:
            episodes = self._run(kernel, centre_D, unit, *given)
            if (key := kernel.inputs_O.tobytes()) not in self._checked:
                mean_O, std_O, *keys = given
                few = [array[: CHECKED * of_each] for array, of_each in zip(keys, (1, 2, 2), strict=True)]
                wanted = kernel.run(kernel.network.pack(centre_D), unit, mean_O, std_O, *few)
                leaves = (jax.tree.leaves(both._replace(fault=None)) for both in (episodes, wanted))
                for leaf, other in zip(*leaves, strict=True):
                    what = f"episodes of {self._spec.environment}"
                    require_same(leaf[: len(other)], other, what, self._gpu.name)
                self._checked.add(key)
            return episodes

    def _run(
        self,
        kernel: EpisodeKernel,
        centre_D: np.ndarray,
        unit: float,
        mean_O: np.ndarray,
        std_O: np.ndarray,
        noise_keys_P: Keys,
        reset_keys_L: Keys,
        action_keys_L: Keys,
    ) -> Episodes:
        inputs_O, pairs = kernel.inputs_O, len(noise_keys_P)
        program, lanes = self.program(inputs_O), 2 * len(noise_keys_P)
        room = self._room(program, inputs_O, pairs)
        resets = kernel.begin(reset_keys_L)
        words = np.concatenate(list(resets), axis=1)[:, :lanes]
        carries, constants, centre, keys, action_keys = map(
            self._gpu.copied,
            (
                np.ascontiguousarray(words),
                np.concatenate([mean_O[inputs_O], std_O[inputs_O]]).astype(np.float32),
                centre_D[program.places],
                np.ascontiguousarray(noise_keys_P),
                np.ascontiguousarray(action_keys_L.T),
            ),
        )
        launch, of_pairs, of_lanes, once = program.module.launch, c_int64(pairs), c_int64(lanes), c_int64(1)
        threads = len(program.places) * pairs
        launch("fill", threads, keys, program.on_gpu, room.noises, of_pairs, c_int64(threads))
        launch("look", lanes, carries, constants, room.seen, of_lanes, once)
        for step in range(self._spec.episode_steps):
            if step % STEPS_BETWEEN_LOOKS == 0 and not carries.read(kernel.alive_word, 1).any():
                break
            x = room.seen
            for number, layer in enumerate(program.layers):
                out, threads = room.hidden[number % 2], layer.tiles * pairs
                numbers = c_float(unit), of_pairs, c_int64(threads)
                launch(layer.name, threads, x, room.noises, centre, out, *numbers)
                x = out
            launch("advance", lanes, carries, constants, x, action_keys, room.seen, of_lanes, once)
        return kernel.results(carries.read(len(words) - kernel.episode_words)[None], lanes)

    def _room(self, program: _Program, inputs_O: np.ndarray, pairs: int) -> _GpuMemory:
        """Memory for a number of pairs; that of another number is freed."""
        key = inputs_O.tobytes(), pairs
        if key not in self._rooms:
            self._rooms.clear()
            widest = max(layer.tiles for layer in program.layers) * TILE
            self._rooms[key] = _GpuMemory(
                self._gpu.array((len(program.places), pairs, TILE), np.uint8),
                self._gpu.array((len(inputs_O), 2 * pairs), np.float32),
                (self._gpu.array((widest, 2 * pairs), np.float32), self._gpu.array((widest, 2 * pairs), np.float32)),
            )
        return self._rooms[key]
