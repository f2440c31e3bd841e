"""Layout of a policy's weights in memory, for the code that `network.py` makes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.policy_spec import Activation, Output, PolicySpec
from workers.simd.backend.native import ALIGNMENT, aligned
from workers.simd.backend.target import Target

KEPT_BYTES = 1 << 18
"""Most bytes of the weights that are kept for a block of members; they are read in each step and must stay in L2."""


class Layer(NamedTuple):
    """Layout of a hidden layer's weights: tiles of outputs, in each the inputs and then the biases, in each outputs."""

    inputs: int
    outputs: int
    tiles: int
    """Number of tiles."""
    tile: int
    """Vectors of outputs in a tile, which are summed at the same time."""
    first: int
    """Number of the layer's first vector of weights."""
    activation: Activation
    """Function of its sums."""
    bias: bool


class Network(NamedTuple):
    """A policy's layers and the place of each weight in the flat vector of parameters.

    The weights of hidden layers are vectors. Only the place of a vector's first lane is kept, and the other lanes
    follow it. (Lanes beyond the end of a row hold weights of the next row; they are never used.) The weights of the
    last layer are single numbers, ordered by inputs with the biases last, and for each input by outputs.
    """

    hidden: tuple[Layer, ...]
    inputs: int
    """Inputs of the last layer."""
    outputs: int
    """Outputs of the last layer."""
    vectors: int
    """Number of vectors of weights of all hidden layers."""
    places: NDArray[np.uint32]
    """Places in the flat vector of parameters: of the vectors, then of the single weights."""
    target: Target
    """Target of the code, whose vectors these are."""
    output: Output
    """Function of the last layer's sums; all but `tanh` are computed elsewhere."""
    bias: bool

    @property
    def width(self) -> int:
        """Lanes of a vector."""
        return self.target.width

    @property
    def hidden_vectors(self) -> int:
        """Number of vectors that hold the outputs of two layers, for as many members as there are lanes."""
        return 2 * self.width * max((layer.tiles * layer.tile for layer in self.hidden), default=0)

    @property
    def rows(self) -> int:
        """Number of vectors that hold all weights."""
        return self.vectors - -(len(self.places) - self.vectors) // self.width

    @property
    def noise_bytes(self) -> int:
        """Number of bytes of the noise of a block of members."""
        return self._pair_weights + (len(self.places) - self.vectors) * self.width

    @property
    def keeps_weights(self) -> bool:
        """Whether the hidden layers' weights of a block's + members are made once per episode, and not in each step."""
        return 0 < 4 * self._pair_weights <= KEPT_BYTES

    @property
    def kept_at(self) -> int:
        """Byte of the noise's memory at which these weights begin, as float32 [pair, vector, lane]."""
        return -(-self.noise_bytes // ALIGNMENT) * ALIGNMENT

    @property
    def block_bytes(self) -> int:
        """Number of bytes of the noise of a block of members and of the weights that are kept."""
        return self.kept_at + 4 * self._pair_weights * self.keeps_weights

    @property
    def _pair_weights(self) -> int:
        """Number of weights in vectors of a block's pairs, one for each pair."""
        return self.width // 2 * self.vectors * self.width

    def pack(self, parameters_D: NDArray[np.float32]) -> NDArray[np.float32]:
        """Array [rows, width] of the vectors of weights, followed by the single weights."""
        padded_D = np.concatenate([parameters_D, np.zeros(self.width, np.float32)])
        of_vectors, single = self.places[: self.vectors], self.places[self.vectors :]
        weights = aligned((self.rows, self.width)).view(np.float32)
        weights[: self.vectors] = padded_D[of_vectors[:, None] + np.arange(self.width, dtype=np.uint32)]
        weights.reshape(-1)[self.vectors * self.width :][: len(single)] = padded_D[single]
        return weights

    def room_for_weights(self, policies: int, parameters: int) -> tuple[NDArray[np.float32], NDArray[np.uint64]]:
        """Room for policies of kernels with own weights: (their parameters [N, D], the address of each one's).

        The array must live as long as the addresses are used.
        """
        # Rows begin at whole vectors, and a vector that begins in the last row ends in this memory.
        stride = (parameters // self.width + 2) * self.width
        rows = aligned((policies, stride)).view(np.float32)
        return rows[:, :parameters], rows.ctypes.data + np.arange(len(rows), dtype=np.uint64) * np.uint64(
            rows.strides[0]
        )


def plan(spec: PolicySpec, inputs_O: NDArray[np.intp], target: Target) -> Network:
    """Lay out a policy's weights.

    Args:
        spec: the policy, without a memory. Without biases, their places are those of other weights, and never used.
        inputs_O: inputs of the first layer that are computed; others are always zero.
        target: what the code is for.
    """
    layers, places, coordinate, width = [], [], 0, target.width
    # With noise, four pairs are computed at a time. They share what is made of the centre, so few vectors of many pairs
    # cost less than many vectors of few. Tiles are powers of 2, so that the members that fit divide the width.
    most = max(1, target.sums_at_once // 8)
    rows, (*hidden, (inputs, outputs)) = inputs_O.tolist(), spec.layers
    for given, wanted in hidden:
        vectors = -(-wanted // width)
        tile = max(size for size in (1, 2) if size <= most and vectors % size == 0)
        layers.append(Layer(len(rows), wanted, vectors // tile, tile, len(places), spec.activation, spec.bias))
        for first in range(0, vectors, tile):
            for row in [*rows, given if spec.bias else 0]:
                places += [coordinate + row * wanted + (first + v) * width for v in range(tile)]
        coordinate += (given + spec.bias) * wanted
        rows = list(range(wanted))
    vectors = len(places)
    places += [
        coordinate + row * outputs + output for row in [*rows, inputs if spec.bias else 0] for output in range(outputs)
    ]
    kept = np.array(places, np.uint32)
    return Network(tuple(layers), len(rows), outputs, vectors, kept, target, spec.output, spec.bias)
