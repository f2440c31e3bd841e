"""The functions of `workers.xla` compiled with simd, and the check whether simd supports a task."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable, Mapping
from functools import partial
from itertools import accumulate
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.messages import PolicySpec, TaskSpec, WorkerSpec
from es_service.protocol.noise import KEY_WORDS
from es_service.protocol.options import OptionValue, option_values
from es_service.protocol.policies import Recipes
from workers.compiling import Compilable
from workers.environments import Environment, make_environment
from workers.episode import Carry
from workers.rollouts.backend import Episodes, no_faults
from workers.simd.backend.native import Native, aligned, load_compiled, require
from workers.simd.backend.target import Target, host_target, target_of
from workers.simd.episodes.check import check_episodes, check_gradient, check_resets
from workers.simd.episodes.compiled import EpisodeKernel, compile_episodes
from workers.simd.episodes.noise_kernels import UNROLLED, definition, gradient_module, make_variation
from workers.simd.episodes.program import EpisodeProgram, write_episodes
from workers.simd.frontend.trace import trace_jaxpr
from workers.simd.graph.graph import UnsupportedError, fault

KEPT_PACKED = 4
"""Number of centres whose packed weights are kept, for work items that share centres."""


def why_not(task: TaskSpec, given: Mapping[str, OptionValue] = MappingProxyType({})) -> str:
    """Reason why simd cannot run a task's episodes; empty if it can.

    This compiles the steps of training episodes to LLVM IR. Evaluation episodes contain nothing else that may be
    unsupported. A reset is never a reason, because JAX computes those that simd cannot compile.

    Args:
        given: values of options; the others have their defaults.
    """
    try:
        options = option_values(task.options, given)
        training_program(task, options, make_environment(task.name, options)).text()
    except UnsupportedError as error:
        return str(error)
    except Exception as error:  # also after a fault of the compiler, xla can run the task
        return fault(error)
    return ""


def training_program(task: TaskSpec, options: Mapping[str, OptionValue], environment: Environment) -> EpisodeProgram:
    """The program of a task's training episodes with a small policy.

    Args:
        environment: that of the task with these options.

    Raises:
        UnsupportedError: a step of the task cannot be compiled.
    """
    spec = WorkerSpec(
        seed=0,
        environment=task.name,
        environment_options=dict(options),
        policy=PolicySpec((task.observation_size, task.action_size)),
        episode_steps=task.episode_steps,
        fitness="sum",
        episodes_per_member=1,
        observation_clip=1.0,
        action_noise=1.0,
        common_random_numbers=True,
        chunk_pairs=1,
        rollout_block_pairs=1,
        gradient_block_pairs=1,
        rollout="simd",
    )
    return write_episodes(environment, spec, np.arange(task.observation_size), target_of("avx2"), training=True)


def make_training_rollout(
    environment: Environment, spec: WorkerSpec, elsewhere: Compilable | None = None
) -> Compilable:
    """Rollout of one training chunk, with the interface of `workers.xla.make_training_rollout`.

    Args:
        elsewhere: function (kernel, centre_D, arguments of `EpisodeKernel.run` after the weights) -> Episodes with the
            same bits, which is called in its place; its `compile` takes a kernel.
    """
    with_faults = partial(_with_faults, allow_infeasible=spec.allow_infeasible)
    kernels = _Kernels(environment, spec, training=True)

    def rollout(centre_D, unit, mean_O, std_O, noise_keys_P, reset_keys_P_S_E, action_keys_P_S_E):
        kernel, weights = kernels.for_centre(centre_D, mean_O)
        by_episode = []

        def again(lane_M: np.ndarray, *keys_L: np.ndarray) -> Episodes:
            finder, weights = kernels.for_centre(centre_D, mean_O, finds_faults=True)
            keys_M = (keys[lane_M] for keys in keys_L)
            return finder.run(weights, unit, mean_O, std_O, noise_keys_P[lane_M[::2] // 2], *keys_M)

        for episode in range(spec.episodes_per_member):
            keys = (keys_P_S_E[:, :, episode] for keys_P_S_E in (reset_keys_P_S_E, action_keys_P_S_E))
            keys_L = [keys_P_S.reshape(-1, KEY_WORDS) for keys_P_S in keys]
            given = (unit, mean_O, std_O, noise_keys_P, *keys_L)
            episodes = kernel.run(weights, *given) if elsewhere is None else elsewhere(kernel, centre_D, *given)
            by_episode.append(with_faults(episodes, lambda lane_M, keys_L=keys_L: again(lane_M, *keys_L), pairs=True))
        axes = (len(noise_keys_P), 2, spec.episodes_per_member)
        if len(by_episode) == 1:
            return jax.tree.map(lambda leaf: leaf.reshape(*axes, *leaf.shape[1:]), by_episode[0])
        if any(episodes.fault is not None for episodes in by_episode):  # then all have some, to be put together
            by_episode = [x if x.fault is not None else x._replace(fault=no_faults(len(x.steps))) for x in by_episode]
        return jax.tree.map(lambda *leaves: np.stack(leaves, axis=1).reshape(*axes, *leaves[0].shape[1:]), *by_episode)

    def compile_for(centre_D, unit, mean_O, std_O, noise_keys_P, reset_keys_P_S_E, action_keys_P_S_E):
        kernel = kernels.fitting(mean_O)
        kernel.begin.compile(reset_keys_P_S_E[:, :, 0].reshape(-1, KEY_WORDS))
        if elsewhere is not None:
            elsewhere.compile(kernel)

    return Compilable(rollout, compile_for)


def make_evaluation_rollout(environment: Environment, spec: WorkerSpec) -> Compilable:
    """Rollout of one evaluation chunk, with the interface of `workers.xla.make_evaluation_rollout`."""
    with_faults = partial(_with_faults, allow_infeasible=spec.allow_infeasible)
    kernels = _Kernels(environment, spec, training=False)

    def rollout(centre_D, mean_O, std_O, reset_keys_E, wanted_E):
        def run(keys_E: np.ndarray, wanted_E: np.ndarray | None = None, *, finds_faults: bool = False) -> Episodes:
            kernel, weights = kernels.for_centre(centre_D, mean_O, finds_faults=finds_faults)
            return kernel.run(weights, 0.0, mean_O, std_O, None, keys_E, keys_E, wanted_E)

        episodes = run(reset_keys_E, wanted_E)
        return with_faults(episodes, lambda lane_M: run(reset_keys_E[lane_M], finds_faults=True), wanted_E)

    def compile_for(centre_D, mean_O, std_O, reset_keys_E, wanted_E):
        kernels.fitting(mean_O).begin.compile(reset_keys_E)

    return Compilable(rollout, compile_for)


def make_policy_rollout(environment: Environment, spec: WorkerSpec) -> Compilable:
    """Rollout of explicit policies, with the interface of `workers.xla.make_policy_rollout`, for any number of
    lanes."""
    with_faults = partial(_with_faults, allow_infeasible=spec.allow_infeasible)
    kernels = _Kernels(environment, spec, training=False, per_lane_weights=True)
    make = make_variation()

    def rollout(policies, mean_L_O, std_L_O, policy_L, reset_keys_L):
        kernel = kernels.fitting(mean_L_O)
        rows, addresses_N = kernel.network.room_for_weights(sum(map(len, policies)), spec.policy.parameters)
        for first, parameters_N_D in zip(accumulate(map(len, policies), initial=0), policies, strict=False):
            part = rows[first : first + len(parameters_N_D)]
            if isinstance(parameters_N_D, Recipes):
                make(parameters_N_D, part)
            else:
                require(
                    parameters_N_D.shape == part.shape,
                    f"parameters {parameters_N_D.shape} have the wrong shape, not {part.shape}",
                )
                part[...] = parameters_N_D
        require(0 <= policy_L.min() <= policy_L.max() < len(rows), "policy_L names rows that are not there")

        def run(kernel: EpisodeKernel, lane_M: Any) -> Episodes:
            keys_M = reset_keys_L[lane_M]
            given = mean_L_O[lane_M], std_L_O[lane_M], None, keys_M, keys_M
            return kernel.run(addresses_N[policy_L[lane_M]], 0.0, *given)

        finder = partial(kernels.fitting, mean_L_O, finds_faults=True)
        return with_faults(run(kernel, slice(None)), lambda lane_M: run(finder(), lane_M))

    def compile_for(policies, mean_L_O, std_L_O, policy_L, reset_keys_L):
        kernels.fitting(mean_L_O).begin.compile(reset_keys_L)

    return Compilable(rollout, compile_for)


def make_watched_rollout(environment: Environment, spec: WorkerSpec, *, per_lane_weights: bool) -> Callable[..., Carry]:
    """Rollout of one episode, with the interface of `workers.xla.make_watched_rollout`.

    An episode's bits depend neither on its slot nor on whether its weights are those of a centre or of a policy.
    """
    kernels = _Kernels(environment, spec, training=False)

    def rollout(centre_D, mean_O, std_O, reset_key, slot):
        kernel, weights = kernels.for_centre(centre_D, mean_O)
        return kernel.watch(weights, mean_O, std_O, reset_key)

    return rollout


def _with_faults(
    episodes: Episodes,
    again: Callable[[np.ndarray], Episodes],
    wanted_L: np.ndarray | None = None,
    *,
    pairs: bool = False,
    allow_infeasible: bool = False,
) -> Episodes:
    """Episodes [L] of a kernel that finds no faults, with those of its traces of faults.

    To look for faults would cost small policies some percent of their speed, so only episodes whose results are not
    finite run again.

    Args:
        again: function from lanes [M] to their episodes [M], by a kernel that finds faults.
        wanted_L: lanes that count; None for all.
        pairs: whether neighbouring lanes can only run together.
        allow_infeasible: whether a fitness of -inf alone is no reason to look.
    """
    if episodes.fault is None:
        return episodes
    results = (episodes.fitness[:, None], episodes.returns[:, None], episodes.descriptor)
    is_suspect_L = ~np.isfinite(np.concatenate(results, axis=1)).all(axis=1)
    if allow_infeasible:
        is_suspect_L &= episodes.fitness != -np.inf
    is_suspect_L |= ~np.isfinite(episodes.shifted_square_sum_O).all(axis=1)
    if wanted_L is not None:
        is_suspect_L &= wanted_L
    if pairs:
        is_suspect_L = is_suspect_L.reshape(-1, 2).any(axis=1).repeat(2)
    lane_M = np.flatnonzero(is_suspect_L)
    if not lane_M.size:
        return episodes

    def put(array_L: np.ndarray, array_M: np.ndarray) -> np.ndarray:
        array_L = array_L.copy()
        array_L[lane_M] = array_M
        return array_L

    return jax.tree.map(put, episodes, again(lane_M))


class _Kernels:
    """Kernels of a run: one that omits inputs that are always zero, and one with all inputs; each with and without
    finding faults.

    The second is used when the statistics have a mean other than 0 for such an input.
    """

    def __init__(
        self, environment: Environment, spec: WorkerSpec, *, training: bool, per_lane_weights: bool = False
    ) -> None:
        self._environment, self._spec = environment, spec
        self._training, self._per_lane_weights = training, per_lane_weights
        self._zero_O = always_zero(environment)
        if self._zero_O.all():
            self._zero_O[0] = False
        self._compiled: dict[tuple[bool, bool], EpisodeKernel] = {}
        self._lock = threading.Lock()
        self._packed: tuple[tuple[bool, np.ndarray, np.ndarray], ...] = ()

    def fitting(self, mean: np.ndarray, *, finds_faults: bool = False) -> EpisodeKernel:
        """The kernel for statistics with this mean, [O] or [L, O]."""
        return self._kernel(self._omits_zero_inputs(mean), finds_faults)

    def _omits_zero_inputs(self, mean: np.ndarray) -> bool:
        return not mean[..., self._zero_O].any()  # then (0 - mean) / std is 0 and contributes nothing

    def _kernel(self, omit_zero_inputs: bool, finds_faults: bool) -> EpisodeKernel:
        with self._lock:  # threads share the kernels
            if (kind := (omit_zero_inputs, finds_faults)) not in self._compiled:
                inputs_O = np.flatnonzero(~self._zero_O) if omit_zero_inputs else np.arange(self._zero_O.size)
                try:
                    self._compiled[kind] = compile_episodes(
                        self._environment,
                        self._spec,
                        inputs_O,
                        training=self._training,
                        per_lane_weights=self._per_lane_weights,
                        finds_faults=finds_faults,
                        check=check_episodes,
                        check_resets=partial(check_resets, environment=self._spec.environment),
                    )
                except UnsupportedError as error:  # shipped tasks are not examined
                    raise UnsupportedError(
                        f"simd cannot compile {self._spec.environment}: {error}; set compute.rollout to xla"
                    ) from error
        return self._compiled[kind]

    def for_centre(
        self, centre_D: np.ndarray, mean_O: np.ndarray, *, finds_faults: bool = False
    ) -> tuple[EpisodeKernel, np.ndarray]:
        """(kernel, packed weights) of a centre; the packed weights of the last KEPT_PACKED centres are kept."""
        omit_zero_inputs = self._omits_zero_inputs(mean_O)
        kernel, kept = self._kernel(omit_zero_inputs, finds_faults), self._packed
        for omitted, packed_D, weights in kept:
            if omitted == omit_zero_inputs and np.array_equal(packed_D, centre_D):
                return kernel, weights
        weights = kernel.network.pack(centre_D)
        self._packed = ((omit_zero_inputs, centre_D.copy(), weights), *kept[: KEPT_PACKED - 1])
        return kernel, weights


def make_gradient_sum(parameters: int, target: Target | None = None) -> Compilable:
    """Sum of weighted noise, with the interface of `workers.xla.make_gradient_sum`; it is compiled here."""
    target = target or host_target()
    signature = [*[ctypes.c_void_p] * 2, ctypes.c_int64, ctypes.c_void_p, ctypes.c_int64]
    group = UNROLLED * target.width
    groups = -(-parameters // group)

    def function(native: Native) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        call = native.function(*signature)

        def gradient_sum(weights_P: np.ndarray, noise_keys_P: np.ndarray) -> np.ndarray:
            weights_P, keys_P = np.ascontiguousarray(weights_P, np.float32), np.ascontiguousarray(noise_keys_P)
            require(keys_P.dtype == np.uint32 and keys_P.shape == (len(weights_P), KEY_WORDS), "a key for each weight")
            sums = aligned((groups, group)).view(np.float32)
            call(weights_P, keys_P, len(weights_P), sums, groups)
            return sums.reshape(-1)[:parameters]

        return gradient_sum

    name, text = f"gradient {definition()}", lambda: gradient_module(target)
    checked = lambda native: check_gradient(function(native), parameters)  # noqa: E731
    gradient_sum = function(load_compiled(name, text, target, check=checked))
    return Compilable(gradient_sum, lambda *_: None)


def always_zero(environment: Environment) -> np.ndarray:
    """Array [O] that is true for observations that are 0 in every state."""
    state = jax.eval_shape(environment.reset, jax.ShapeDtypeStruct((KEY_WORDS,), jnp.uint32))
    graph, _, outputs = trace_jaxpr(jax.make_jaxpr(environment.observe)(state))
    return np.array([graph.constant(node) == 0.0 for node in outputs])
