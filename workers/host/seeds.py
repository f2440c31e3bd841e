"""Seeds of resets for the generators of users."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def seed_of(reset_key_4: NDArray[np.uint32]) -> int:
    """The seed of a reset, a whole number below 2^31, which every generator accepts, from its stream key."""
    return int(reset_key_4[0]) >> 1
