"""Where the weights of a policy are, for the code that network.py makes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.messages import PolicyShape
from workers.simd.backend.words import aligned


class Layer(NamedTuple):
    """Where a hidden layer's weights are: by tiles of outputs, in each by inputs (and last the biases), in each by
    outputs."""

    inputs: int
    outputs: int
    tiles: int
    tile: int
    """Vectors of outputs that are summed at once."""
    first: int
    """Number of its first vector of weights."""


class Network(NamedTuple):
    """A policy's layers, and the place of each weight in the flat vector of parameters.

    Weights are vectors of the hidden layers, of which only the first lane's place is given, the others following it
    (what a vector has beyond a row's end belongs to the next and is never looked at), and single weights of the last
    layer, by inputs (and last the biases), in each by outputs.
    """

    hidden: tuple[Layer, ...]
    inputs: int
    """Of the last layer."""
    outputs: int
    vectors: int
    places: NDArray[np.uint32]
    """Of the vectors, then of the single weights."""
    width: int

    @property
    def hidden_vectors(self) -> int:
        """Vectors that the outputs of two layers take, of as many members as there are lanes."""
        return 2 * self.width * max((layer.tiles * layer.tile for layer in self.hidden), default=0)

    @property
    def rows(self) -> int:
        """Vectors that all weights take."""
        return self.vectors - -(len(self.places) - self.vectors) // self.width

    @property
    def noise_bytes(self) -> int:
        """Bytes of the noise of a block of members."""
        return self.width // 2 * self.vectors * self.width + (len(self.places) - self.vectors) * self.width

    def pack(self, parameters_D: NDArray[np.float32]) -> NDArray[np.float32]:
        """The vectors of weights, then the single ones, [rows, width]."""
        padded_D = np.concatenate([parameters_D, np.zeros(self.width, np.float32)])
        of_vectors, single = self.places[: self.vectors], self.places[self.vectors :]
        weights = aligned((self.rows, self.width)).view(np.float32)
        weights[: self.vectors] = padded_D[of_vectors[:, None] + np.arange(self.width, dtype=np.uint32)]
        weights.reshape(-1)[self.vectors * self.width :][: len(single)] = padded_D[single]
        return weights


def sums_at_once(width: int) -> int:
    """Vectors of sums that fit into registers beside what is added to them: 32 of 512 bits, or 16 of 256."""
    return 16 if width == 16 else 8


def plan(shape: PolicyShape, inputs_O: NDArray[np.intp], width: int) -> Network:
    """Lay out a policy's weights.

    Args:
        inputs_O: the inputs of the first layer that are not always zero.
    """
    layers, places, coordinate = [], [], 0
    most = sums_at_once(width) // 4  # tiles are powers of 2, so that as many members as fit divide the width
    rows, (*hidden, (inputs, outputs)) = inputs_O.tolist(), shape.layers
    for given, wanted in hidden:
        vectors = -(-wanted // width)
        tile = max(size for size in (1, 2, 4) if size <= most and vectors % size == 0)
        layers.append(Layer(len(rows), wanted, vectors // tile, tile, len(places)))
        for first in range(0, vectors, tile):
            for row in [*rows, given]:
                places += [coordinate + row * wanted + (first + v) * width for v in range(tile)]
        coordinate += (given + 1) * wanted
        rows = list(range(wanted))
    vectors = len(places)
    places += [coordinate + row * outputs + output for row in [*rows, inputs] for output in range(outputs)]
    return Network(tuple(layers), len(rows), outputs, vectors, np.array(places, np.uint32), width)
