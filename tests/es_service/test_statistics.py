"""Moments of observations."""

import numpy as np

from es_service.loop.state import merge_moments, no_observations


def test_merged_moments_equal_those_of_all_observations_at_once():
    rng = np.random.default_rng(0)
    parts = [rng.normal(3.0, 2.0, (n, 2)) for n in (5, 1, 100)]
    from es_service.protocol.messages import Moments

    moments = [Moments(len(x), x.mean(0), x.var(0) * len(x)) for x in parts]
    total = merge_moments(no_observations(2), [*moments, no_observations(2)])
    everything = np.concatenate(parts)
    assert total.count == 106
    np.testing.assert_allclose(total.mean_O, everything.mean(0))
    np.testing.assert_allclose(total.m2_O, everything.var(0) * 106)
