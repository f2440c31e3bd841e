"""The first weights of a policy."""

import numpy as np

from es_service.protocol.messages import PolicySpec
from workers.policies.policy import initial_parameters


def test_initial_columns_have_their_norms_and_layers_differ():
    shape = PolicySpec((8, 8, 8, 8))  # equal shapes on purpose: one key for all layers would make them equal
    for init, norms in (("unit_columns", (1.0, 1.0, 0.01)), ("small_columns", (0.01, 0.01, 0.01))):
        flat = initial_parameters(shape, init, seed=0)
        layers = [flat[start : start + 64].reshape(8, 8) for start in (0, 72, 144)]
        biases = [flat[start : start + 8] for start in (64, 136, 208)]
        for weights, norm in zip(layers, norms, strict=True):
            np.testing.assert_allclose(np.linalg.norm(weights, axis=0), norm, rtol=1e-5)
        assert not np.any(biases)
        assert not np.allclose(layers[0] / norms[0], layers[1] / norms[1])
    other = initial_parameters(shape, "unit_columns", seed=0, centre=1)
    assert not np.allclose(other, initial_parameters(shape, "unit_columns", seed=0))
