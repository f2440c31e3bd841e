"""The memory of a policy: a gated recurrent cell (GRU), and the dense layers that it is made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


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
