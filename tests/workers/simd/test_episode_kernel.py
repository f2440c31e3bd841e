"""What goes into an episode kernel has the size that its code reads."""

from __future__ import annotations

import numpy as np
import pytest

from es_service.protocol.noise import KEY_WORDS
from tests.helpers import SPEC, random_parameters
from workers.environments import make_environment
from workers.simd.episodes.compiled import compile_episodes

LANES = 6


@pytest.mark.parametrize("training", [True, False])
def test_arrays_of_other_sizes_are_refused(training: bool) -> None:
    kernel = compile_episodes(make_environment("point_maze", {}), SPEC, np.arange(2), training=training)
    weights, mean_O, std_O = kernel.network.pack(random_parameters()), np.zeros(2, np.float32), np.ones(2, np.float32)

    def run(noise: int | None, resets: int = LANES, actions: int = LANES, words: int = KEY_WORDS) -> None:
        noise_keys_P = None if noise is None else np.zeros((noise, words), np.uint32)
        reset_keys_L, action_keys_L = (np.zeros((rows, KEY_WORDS), np.uint32) for rows in (resets, actions))
        kernel.run(weights, 0.01, mean_O, std_O, noise_keys_P, reset_keys_L, action_keys_L)

    enough = LANES // 2 if training else None
    run(enough)
    wrong = [(enough, LANES, LANES - 1), (enough, 1, LANES), (None if training else LANES // 2, LANES, LANES)]
    wrong += [(enough - 1, LANES, LANES), (enough, LANES, LANES, 3)] if enough else []
    for sizes in wrong:
        with pytest.raises(AssertionError):
            run(*sizes)
