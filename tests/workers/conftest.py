"""What tests of rollouts share."""

from functools import partial

import pytest


@pytest.fixture(params=["xla", "simd"])
def spec(request):
    """The tiny spec with changes, for each value of `compute.rollout`."""
    from tests import helpers  # imports JAX, which must not be before its settings

    return partial(helpers.spec, rollout=request.param)
