"""Policies of several environments at once in NumPy, each with one policy; their parameter noise and gradients.

A policy's numbers depend on nothing but itself and its observations: every product is that of one policy, whatever
their number. So an episode has the same bits in every chunk. Axes: P pairs, D policy parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from es_service.protocol.messages import SIGNS, FloatArray, WorkerSpec
from es_service.protocol.noise import NORMAL_STD, normal_integers
from es_service.protocol.policy_spec import noise_integers
from workers.policies.policy import Layers, act, action, drawn_action, initial_memory, normalise, split_layers


class LanePolicies:
    """The policies of lanes L during one episode of each, with their memories."""

    def __init__(
        self,
        spec: WorkerSpec,
        parameters_L_D: FloatArray,
        mean: FloatArray,
        std: FloatArray,
        action_keys_L_4: Any = None,
    ) -> None:
        """Begin episodes.

        Args:
            mean, std: observation statistics, [O] of all lanes or [L, O].
            action_keys_L_4: stream keys of the action noise of training episodes; None for evaluations.
        """
        self._spec, self._mean, self._std = spec, mean, std
        self._layers = _lane_layers(spec, parameters_L_D)
        self._first_memory = self._memory = initial_memory(np, spec.policy, len(parameters_L_D), 1)
        self._key = (
            None if action_keys_L_4 is None else action_keys_L_4.T[:, :, None]
        )  # [4, L, 1]: a word for each lane
        self._unit = np.float32(spec.action_noise / NORMAL_STD)

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # such a policy's episode is invalid, not an error
    def __call__(self, observation_L_O: FloatArray, step: int) -> FloatArray:
        """Actions [L, A] of a step, the steps counted from 0, where episodes begin, also again."""
        policy = self._spec.policy
        x_L_O = normalise(np, observation_L_O, self._mean, self._std, self._spec.observation_clip)
        memory = self._first_memory if step == 0 else self._memory
        outputs, self._memory = act(np, policy, self._layers, memory, x_L_O[:, None])
        outputs_L = outputs[:, 0]
        if self._key is None:
            return action(np, policy.output, outputs_L)
        actions = np.uint32(policy.widths[-1])
        coordinates_A = np.arange(actions, dtype=np.uint32) + np.uint32(step) * actions
        action_L_A = drawn_action(np, policy.output, outputs_L, self._key, coordinates_A)
        if self._spec.action_noise == 0.0:
            return action_L_A
        return action_L_A + self._unit * normal_integers(np, self._key, coordinates_A).astype(np.float32)


def _lane_layers(spec: WorkerSpec, parameters_L_D: FloatArray) -> Layers:
    """Layers of all lanes as views: (weights [L, in, out], biases [L, 1, out] or None) of each layer."""
    lanes, row_D = len(parameters_L_D), np.arange(spec.policy.parameters)
    layers = []
    for weights, biases in split_layers(spec.policy, row_D):
        of_weights = parameters_L_D[:, weights.flat[0] : weights.flat[-1] + 1].reshape(lanes, *weights.shape)
        of_biases = None if biases is None else parameters_L_D[:, None, biases[0] : biases[-1] + 1]
        layers.append((of_weights, of_biases))
    return layers


_SIGNS_S = np.asarray(SIGNS, np.float32)


def members(spec: WorkerSpec, centre_D: FloatArray, unit: Any, noise_keys_P_4: Any) -> FloatArray:
    """Parameters of the members of pairs, [P, S, D]: centre + sign * unit * noise."""
    noise_P_D = noise_integers(spec.policy, spec.noise_rank, noise_keys_P_4)
    return centre_D + np.multiply.outer(noise_P_D, np.float32(unit) * _SIGNS_S).swapaxes(1, 2)


def gradient_summer(spec: WorkerSpec) -> Callable[[Any, Any], FloatArray]:
    """See `ChunkFunctions.gradient_sum`."""

    def gradient_sum(weights_P: Any, noise_keys_P_4: Any) -> FloatArray:
        sum_D = np.zeros(spec.policy.parameters, np.float32)
        for weight, key in zip(weights_P, noise_keys_P_4, strict=True):
            sum_D += weight * noise_integers(spec.policy, spec.noise_rank, key)
        return sum_D * np.float32(1.0 / NORMAL_STD)

    return gradient_sum
