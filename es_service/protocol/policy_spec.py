"""What a policy is: its layers, its memory and its output; and noise of low rank for its matrices."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.noise import NORMAL_STD, Keys, normals

Activation = Literal["tanh", "relu"]
Output = Literal["tanh", "linear", "argmax", "categorical", "gaussian"]
PolicyOutput = Output | Literal["gumbel"]
"""Values of `policy.output`, and what OF_RANKED makes of them."""
NOISY_OUTPUTS = ("tanh", "linear")
"""Outputs to which action noise can be added: those that are numbers and not random by themselves."""
DISCRETE_OUTPUTS = ("argmax", "categorical")
"""Outputs that choose one of the actions, which is then 1 while the others are 0."""
OF_RANKED: Mapping[str, Literal["linear", "gumbel"]] = {"argmax": "linear", "categorical": "gumbel"}
"""What these are for a task that takes the greatest number of what it allows (`TaskSpec.ranked_actions`): the numbers
by which they would choose. Of any of the logits with Gumbel variates, the greatest has the probabilities of their
softmax."""


@dataclass(frozen=True)
class PolicySpec:
    """Network of a policy. Its parameters are one flat vector [D]: per dense layer weights [in, out], then biases."""

    widths: tuple[int, ...]
    """Widths of the layers, from the observation to the action, without the memory."""
    activation: Activation = "tanh"
    """Function after each hidden layer."""
    output: PolicyOutput = "tanh"
    """What makes an action of the last layer; see `workers.policy`."""
    bias: bool = True
    """Whether the layers have biases."""
    memory: int = 0
    """Units of the gated recurrent cell between the hidden layers and the last one; 0: there is none."""

    @property
    def outputs(self) -> int:
        """Outputs of the last layer: one for each action, and for `gaussian` another one for its spread."""
        return self.widths[-1] * (2 if self.output == "gaussian" else 1)

    @property
    def layers(self) -> tuple[tuple[int, int], ...]:
        """(inputs, outputs) of each dense layer in the order of the parameters.

        A recurrent cell has two, whose inputs are those of the cell followed by the memory: its two gates, and then the
        candidate for the next memory. The layer after the cell has the memory as its input.
        """
        layers, last = list(zip(self.widths[:-2], self.widths[1:-1], strict=True)), self.widths[-2]
        if self.memory:
            layers += [(last + self.memory, 2 * self.memory), (last + self.memory, self.memory)]
            last = self.memory
        return (*layers, (last, self.outputs))

    @property
    def parameters(self) -> int:
        """Number of parameters, D."""
        return sum((inputs + self.bias) * outputs for inputs, outputs in self.layers)


# Noise of low rank: a weight matrix moves along a product of two thin matrices, as in EGGROLL.
#
# The noise of a layer with weights [I, J] and rank r is made of A [r, I] and B [r, J], whose numbers are standard
# normal: that of weight (i, j) is sum over r of A[r, i] B[r, j] / sqrt(r), which has mean 0 and variance 1 as the noise
# of full rank has. Biases, which are no matrices, have numbers of their own. A pair has r (I + J) + J numbers for a
# layer instead of (I + 1) J, and a step of a policy needs one product with the centre's weights and two thin ones.
#
# The numbers of a pair are at the coordinates 0, 1, 2 ... of its stream (`noise.py`): layer after layer A, B and
# biases.
#
# Source: Sarkar et al. 2025 (arXiv:2511.16652).

MOST_RANK = 64
"""Sums of so many products of two noise integers are exact in float32."""


class LayerNoise(NamedTuple):
    """Coordinates of the numbers of a layer."""

    left: NDArray[np.uint32]
    """Those of A, [r, I]."""
    right: NDArray[np.uint32]
    """Those of B, [r, J]."""
    bias: NDArray[np.uint32] | None
    """Those of the biases, [J]; None if there are none."""


def layers_of_noise(policy: PolicySpec, rank: int) -> tuple[LayerNoise, ...]:
    """Coordinates of a pair's numbers, by layer."""
    layers, start = [], 0
    for inputs, outputs in policy.layers:
        sizes = (rank * inputs, rank * outputs, outputs * policy.bias)
        left, right, bias = np.split(np.arange(start, start + sum(sizes), dtype=np.uint32), np.cumsum(sizes)[:-1])
        layers.append(LayerNoise(left.reshape(rank, -1), right.reshape(rank, -1), bias if policy.bias else None))
        start += sum(sizes)
    return tuple(layers)


def numbers(policy: PolicySpec, rank: int) -> int:
    """How many numbers a pair has."""
    return sum(rank * (inputs + outputs) + outputs * policy.bias for inputs, outputs in policy.layers)


def product_unit(rank: int) -> np.float32:
    """What makes a product of two noise integers as large as one noise integer: 1 / (NORMAL_STD sqrt(rank))."""
    return np.float32(1.0 / (NORMAL_STD * math.sqrt(rank)))


def noise_integers(policy: PolicySpec, rank: int, keys: Keys) -> NDArray[np.float32]:
    """Noise of the parameters of pairs, in the unit of `normal_integers`, float32 [..., D].

    Args:
        rank: 0 for noise of full rank, whose numbers are `normal_integers`.
        keys: keys of the pairs' streams [..., 4].
    """
    if not rank:
        return _integers(keys, policy.parameters)
    drawn = _integers(keys, numbers(policy, rank))
    columns: list[Any] = []
    for left, right, bias in layers_of_noise(policy, rank):
        # All sums are whole numbers below 2^24, so that no order of the additions changes them.
        products = np.swapaxes(drawn[..., left], -1, -2) @ drawn[..., right]
        columns.append((products * product_unit(rank)).reshape(*keys.shape[:-1], -1))
        columns += [] if bias is None else [drawn[..., bias]]
    return np.concatenate(columns, axis=-1)


def _integers(keys: Keys, count: int) -> NDArray[np.float32]:
    """`normal_integers` of streams at the first coordinates, as float32 [..., count]."""
    noise = normals(keys, count)
    noise *= np.float32(NORMAL_STD)
    return np.rint(noise, out=noise)
