"""Plain steps: the gradient estimate times a factor."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from es_service.config.parts import PlainStep
from es_service.protocol.messages import FloatArray


def fresh_plain(parameters: int) -> dict[str, np.ndarray]:
    """The state of a plain step, which remembers nothing."""
    return {}


def plain_step(
    settings: PlainStep, state: Mapping[str, np.ndarray], centre_D: FloatArray, gradient_D: FloatArray
) -> tuple[Mapping[str, np.ndarray], FloatArray]:
    """The centre after one step up the gradient estimate: centre - learning_rate * (l2 * centre - gradient).

    Args:
        gradient_D: estimate of the gradient; it points to higher utility.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # the driver refuses a centre that is not finite
        descent_D = centre_D * np.float32(settings.l2) - gradient_D
        return state, np.asarray(centre_D - descent_D * np.float32(settings.learning_rate), np.float32)
