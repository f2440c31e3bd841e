"""The GPUs of this machine, and how the workers of the engine inline share them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

DEVICES = Path("/dev")
"""Folder with a file `nvidiaN` for each NVIDIA GPU that this process may use."""


def places(environment: Mapping[str, str], share: float) -> tuple[str, ...]:
    """What CUDA_VISIBLE_DEVICES must be for each worker for which this machine's GPUs have room.

    Args:
        environment: that of this process. The GPUs are those that its CUDA_VISIBLE_DEVICES names, or else all.
        share: number of GPUs of each worker, or its share of one.

    Returns:
        One text for each worker; of workers that share a GPU the same text. Empty if there is no GPU.
    """
    gpus = _gpus(environment)
    if share < 1:
        return tuple(gpu for gpu in gpus for _ in range(int(1 / share)))
    each = int(share)
    return tuple(",".join(gpus[first : first + each]) for first in range(0, len(gpus) - each + 1, each))


def _gpus(environment: Mapping[str, str]) -> list[str]:
    """The GPUs' names for CUDA_VISIBLE_DEVICES."""
    if (named := environment.get("CUDA_VISIBLE_DEVICES")) is None:
        return [str(index) for index, _ in enumerate(DEVICES.glob("nvidia[0-9]*"))]
    gpus: list[str] = []
    for name in map(str.strip, named.split(",")):
        if name in ("", "-1"):  # CUDA ignores this name and all that follow
            break
        gpus.append(name)
    return gpus
