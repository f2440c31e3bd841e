"""What tests of rollouts share."""

from functools import partial

import pytest

from tests import helpers


@pytest.fixture(params=["xla", "simd"])
def spec(request):
    """The tiny spec with changes, for each value of `compute.rollout`."""
    return partial(helpers.spec, rollout=request.param)
