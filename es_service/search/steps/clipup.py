"""ClipUp: steps of a momentum along normalised gradient estimates, none of them longer than a given speed."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from es_service.config.parts import ClipUpStep
from es_service.protocol.messages import FloatArray

SPEED = 4.0 / 3.0
"""Greatest speed as a multiple of the learning rate, if the config gives none."""


def fresh_clipup(parameters: int) -> dict[str, np.ndarray]:
    """The state before any step: a velocity of 0.

    Args:
        parameters: D, the number of policy parameters.
    """
    return {"velocity_D": np.zeros(parameters, np.float32)}


def clipup_step(
    settings: ClipUpStep, state: Mapping[str, np.ndarray], centre_D: FloatArray, gradient_D: FloatArray
) -> tuple[Mapping[str, np.ndarray], FloatArray]:
    """Take one step up the gradient estimate: (new state, new centre).

    velocity <- momentum * velocity + learning_rate * g / |g| with g = gradient - l2 * centre, shortened to max_speed if
    it is longer; centre <- centre + velocity. Only the direction of the estimate matters, so the length of a step is
    the same whatever the estimate knows, and at most max_speed. If g is 0, nothing is added to the velocity.

    Source: Toklu, Liskowski and Srivastava 2020 (arXiv:2008.02387); if max_speed is not given, it is learning_rate /
    0.75, as in the experiments of EvoTorch. The weight decay is our addition.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # the driver refuses a centre that is not finite
        ascent_D = gradient_D - centre_D * np.float32(settings.l2)
        velocity_D = state["velocity_D"] * np.float32(settings.momentum)
        if length := norm(ascent_D):
            velocity_D = velocity_D + ascent_D * np.float32(settings.learning_rate / length)
        fastest = settings.max_speed or SPEED * settings.learning_rate
        if (speed := norm(velocity_D)) > fastest:
            velocity_D = velocity_D * np.float32(fastest / speed)
        return {"velocity_D": velocity_D}, np.asarray(centre_D + velocity_D, np.float32)


def norm(x_D: np.ndarray) -> float:
    """Euclidean norm; a sum of squares in float64, so that no library for matrices decides about its bits."""
    return math.sqrt(float(np.sum(np.square(x_D, dtype=np.float64))))
