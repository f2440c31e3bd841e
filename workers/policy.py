"""A policy: hidden layers, perhaps a memory, and a last layer, whose parameters are one flat vector.

This module imports only NumPy, so that the driver can make the first centre and users can run a policy without JAX.
Functions that also run inside compiled rollouts take the array namespace as `xp`.

The memory is a gated recurrent cell (GRU). Actions are made of the outputs of the last layer by `policy.output`:

tanh, linear: the outputs themselves; `tanh` has been applied by the network.
argmax: the action with the greatest output is 1, the first of equal ones, and the others are 0.
categorical: the same, drawn with probabilities that are the softmax of the outputs.
gaussian: tanh of a normal variate, whose mean and log of the standard deviation are the two halves of the outputs.

A task may choose by itself, such as where a mask forbids some actions (`TaskSpec.ranked_actions`). It takes the action
with the greatest of the numbers that it gets: the outputs, or with `categorical` the outputs plus Gumbel variates
(`gumbel`).

Only training episodes draw. In evaluations `categorical` takes the most probable action, as `argmax` does, and
`gaussian` the tanh of the mean.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from es_service.protocol.messages import SIGNS, FloatArray, WorkerSpec
from es_service.protocol.noise import NORMAL_STD, Domain, normal_integers, normals, stream_keys, uniforms
from es_service.protocol.policy_spec import Activation, PolicyOutput, PolicySpec, noise_integers

_SIGNS_S = np.asarray(SIGNS, np.float32)


def dense(x: Any, weights: Any, biases: Any) -> Any:
    """x @ weights, plus the biases unless they are None."""
    return x @ weights if biases is None else x @ weights + biases


def dense_of_each(x: Any, weights: Any, biases: Any) -> Any:
    """`dense` in NumPy, as a product for each row of x [..., in].

    The libraries that NumPy multiplies with have one kernel for a vector and another one for a matrix. On many
    processors the two round differently, so a row of one large product would differ from the product of that row.
    """
    return dense(x[..., None, :], weights, biases)[..., 0, :]


Dense = Callable[[Any, Any, Any], Any]
"""Function (x, weights, biases or None) -> outputs of a layer before its activation."""


def next_memory(
    xp: Any, gates: tuple[Any, Any], candidate: tuple[Any, Any], memory_H: Any, x: Any, dense: Dense = dense
) -> Any:
    """Memory after a step, between the memory before it and a candidate, as far as the gates say.

        reset, keep = sigmoid(gates [x, memory])
        candidate   = tanh(candidate [x, reset * memory])
        memory      = keep * memory + (1 - keep) * candidate

    Args:
        gates: (weights [in + H, 2 H], biases [2 H] or None), first of the reset gate, then of the keep gate.
        candidate: (weights [in + H, H], biases [H] or None).
        memory_H: [..., H].
        x: input of the cell, [..., in].
        dense: function of a layer before its activation.

    Source: the gated recurrent unit of Cho et al. 2014 (arXiv:1406.1078), with the reset before the product.
    """
    size = memory_H.shape[-1]
    gates_2H = np.float32(0.5) * (xp.tanh(np.float32(0.5) * dense(_joined(xp, x, memory_H), *gates)) + np.float32(1.0))
    reset_H, keep_H = gates_2H[..., :size], gates_2H[..., size:]
    candidate_H = xp.tanh(dense(_joined(xp, x, reset_H * memory_H), *candidate))
    return keep_H * memory_H + (np.float32(1.0) - keep_H) * candidate_H


def _joined(xp: Any, x: Any, memory_H: Any) -> Any:
    return xp.concatenate([x, memory_H], axis=-1)


INITIAL_COLUMN_NORMS = {"unit_columns": (1.0, 0.01), "small_columns": (0.01, 0.01)}
"""(column norm of hidden layers, column norm of the output layer) for each value of `policy.init`.

Sources: unit_columns, OpenAI ES and deep-neuroevolution; small_columns, the released ME-ES code.
"""

Layers = list[tuple[Any, Any]]
"""(weights [in, out], biases [out] or None) of each layer."""


def split_layers(spec: PolicySpec, parameters_D: Any) -> Layers:
    """Layers of a policy as views of its flat vector: (weights [in, out], biases [out] or None) per layer."""
    layers, start = [], 0
    for inputs, outputs in spec.layers:
        end = start + inputs * outputs
        biases = parameters_D[end : end + outputs] if spec.bias else None
        layers.append((parameters_D[start:end].reshape(inputs, outputs), biases))
        start = end + outputs * spec.bias
    return layers


def initial_memory(xp: Any, spec: PolicySpec, *axes: int) -> Any:
    """Memory at the start of an episode, zeros [..., H] with the given leading axes; None for a policy without one."""
    return xp.zeros((*axes, spec.memory), np.float32) if spec.memory else None


def act(
    xp: Any, spec: PolicySpec, layers: Layers, memory_H: Any, observation_O: Any, dense: Dense = dense
) -> tuple[Any, Any]:
    """Results of one step of a policy.

    Args:
        memory_H: the memory before the step; None for a policy without one.
        observation_O: a normalised observation.
        dense: function of a layer before its activation.

    Returns:
        (outputs of the last layer, of which `workers.policy` makes an action; the memory after the step)
    """
    hidden = spec.layers[: len(spec.widths) - 2]
    x = observation_O
    for weights, biases in layers[: len(hidden)]:
        x = activated(xp, spec.activation, dense(x, weights, biases))
    if spec.memory:
        gates, candidate = layers[len(hidden) : -1]
        memory_H = x = next_memory(xp, gates, candidate, memory_H, x, dense)
    x = dense(x, *layers[-1])
    return xp.tanh(x) if spec.output == "tanh" else x, memory_H


def activated(xp: Any, activation: Activation, x: Any) -> Any:
    """The function after a hidden layer: tanh, or relu, max(x, 0)."""
    return xp.tanh(x) if activation == "tanh" else xp.maximum(x, np.float32(0.0))


def normalise(xp: Any, observation_O: Any, mean_O: Any, std_O: Any, clip: float | None) -> Any:
    """Normalised observation: (observation - mean) / std, clipped to [-clip, clip] unless `clip` is None."""
    x = (observation_O - mean_O) / std_O
    return x if clip is None else xp.clip(x, np.float32(-clip), np.float32(clip))


def initial_parameters(spec: PolicySpec, init: str, seed: int, centre: int = 0) -> FloatArray:
    """Initial parameters of a centre: Gaussian weights, scaled so that the column of each output has a set norm.

    Biases are 0. The layers of a recurrent cell are hidden layers.

    Args:
        init: a key of INITIAL_COLUMN_NORMS.
        centre: number of the centre within the run; each centre draws from its own stream.
    """
    hidden_norm, output_norm = INITIAL_COLUMN_NORMS[init]
    key = stream_keys(seed, Domain.INITIALISATION, 0, centre)
    parameters_D = normals(key, spec.parameters)
    for layer, (weights, biases) in enumerate(split_layers(spec, parameters_D)):
        norm = output_norm if layer == len(spec.layers) - 1 else hidden_norm
        weights *= np.float32(norm) / np.sqrt(np.sum(np.square(weights), axis=0, keepdims=True))
        if biases is not None:
            biases[:] = 0.0
    return parameters_D


LOG_STD = (-5.0, 2.0)
"""Limits of the log of the standard deviation of `gaussian`. Source: usual in implementations of SAC."""
LEAST_UNIFORM = np.float32(2.0**-25)
"""Replacement of a uniform variate of 0: half of the distance between variates."""


def action(xp: Any, output: PolicyOutput, outputs: Any) -> Any:
    """Action [..., A] of an evaluation, from the outputs of the last layer [..., A], or [..., 2 A] of `gaussian`."""
    if output in ("argmax", "categorical"):
        return _chosen(xp, outputs)
    if output == "gaussian":
        return xp.tanh(outputs[..., : outputs.shape[-1] // 2])
    return outputs


def drawn_action(xp: Any, output: PolicyOutput, outputs: Any, key: Any, coordinates_A: Any) -> Any:
    """Action [A] of a step of training, before action noise; without draws it is that of an evaluation.

    Args:
        key: stream key of the episode's action noise.
        coordinates_A: the step's coordinates in that stream, uint32.
    """
    if output in ("categorical", "gumbel"):
        # The greatest of logits + Gumbel variates has the probabilities of the softmax.
        uniform_A = xp.maximum(uniforms(key, coordinates_A), LEAST_UNIFORM)
        numbers_A = outputs - xp.log(-xp.log(uniform_A))
        return numbers_A if output == "gumbel" else _chosen(xp, numbers_A)
    if output == "gaussian":
        half = outputs.shape[-1] // 2
        std_A = xp.exp(xp.clip(outputs[..., half:], *map(np.float32, LOG_STD)))
        normal_A = normal_integers(xp, key, coordinates_A).astype(np.float32) * np.float32(1.0 / NORMAL_STD)
        return xp.tanh(outputs[..., :half] + std_A * normal_A)
    return action(xp, output, outputs)


def _chosen(xp: Any, outputs: Any) -> Any:
    choice = xp.argmax(outputs, axis=-1)[..., None]
    return (choice == np.arange(outputs.shape[-1])).astype(np.float32)


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
