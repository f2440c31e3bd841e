"""Policies of libraries in Flax as the flat vectors that our workers run: the same network, layer by layer.

Axes: N policies, D policy parameters, K skills.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from es_service.protocol.messages import FloatArray


def flat(layers: Mapping[str, Any]) -> FloatArray:
    """Layers of N policies, whose names end with their numbers, as [N, D]: kernel and then bias of each."""
    parts = [np.asarray(layer[name]) for layer in _in_order(layers) for name in ("kernel", "bias")]
    return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1).astype(np.float32)


def of_skills(layers: Mapping[str, Any], skills: int, actions: int) -> FloatArray:
    """The K policies [K, D] of one network whose last inputs are a skill, one of K, and whose first outputs are actions
    before tanh, the others their spread: a skill is a bias of the first layer."""
    every = [[np.asarray(layer[name]) for name in ("kernel", "bias")] for layer in _in_order(layers)]
    kernel, bias = every[0]
    every[0] = [kernel[:-skills], bias + kernel[-skills:]]
    every[-1] = [part[..., :actions] for part in every[-1]]
    layers_of_skills = {}
    for number, (kernel, bias) in enumerate(every):
        layers_of_skills[f"layer_{number}"] = {
            "kernel": np.broadcast_to(kernel, (skills, *kernel.shape)),
            "bias": np.broadcast_to(bias, (skills, bias.shape[-1])),
        }
    return flat(layers_of_skills)


def _in_order(layers: Mapping[str, Any]) -> list[Any]:
    return [layers[name] for name in sorted(layers, key=lambda name: int(name.rpartition("_")[2]))]
