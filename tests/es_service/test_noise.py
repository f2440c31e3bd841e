"""Noise: the same bits everywhere, and statistically what it says it is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from es_service.protocol.noise import NORMAL_STD, TEST_VECTORS, Domain, normal_integers, normals, stream_keys, uniforms
from tests.references import noise as reference

COORDINATES = np.arange(4482, dtype=np.uint32)
words = st.integers(0, 2**32 - 1)


def test_several_streams_at_once_have_the_variates_of_each():
    keys = stream_keys(3, Domain.VARIATION, 5, np.arange(21).reshape(7, 3))
    for count in (0, 1, 4483, 40_000):
        coordinate, some = np.arange(count, dtype=np.uint32), keys[: 2 if count > 5000 else 7]
        several = normals(some, count)
        assert several.shape == (*some.shape[:-1], count)
        for at in np.ndindex(some.shape[:-1]):
            expected = normal_integers(np, keys[at], coordinate).astype(np.float32) / np.float32(NORMAL_STD)
            np.testing.assert_array_equal(several[at].view(np.uint32), expected.view(np.uint32))


def test_published_vectors():
    for (seed, domain, generation, ids), expected in TEST_VECTORS:
        key = stream_keys(seed, domain, generation, *ids)
        assert normal_integers(np, key, np.arange(3, dtype=np.uint32)).tolist() == list(expected)


@given(
    seed=st.integers(0, 2**63 - 1), generation=st.integers(0, 2**40), ids=st.lists(st.integers(0, 2**40), max_size=3)
)
def test_stream_keys_equal_the_reference(seed, generation, ids):
    key = stream_keys(seed, Domain.ACTION_NOISE, generation, *ids)
    assert key.tolist() == reference.stream_key(seed, int(Domain.ACTION_NOISE), generation, *ids)


def test_stream_keys_broadcast_over_ids():
    pairs, signs = np.arange(5)[:, None], np.arange(2)[None, :]
    keys = stream_keys(3, Domain.TRAINING_RESET, 9, pairs, signs, 7)
    assert keys.shape == (5, 2, 4)
    assert keys[4, 1].tolist() == stream_keys(3, Domain.TRAINING_RESET, 9, 4, 1, 7).tolist()
    both = stream_keys(3, (Domain.ACTION_NOISE, Domain.TRAINING_RESET), 9, pairs, signs, 7)
    assert both.shape == (2, 5, 2, 4)
    assert both[1].tolist() == keys.tolist()
    assert both[0].tolist() == stream_keys(3, Domain.ACTION_NOISE, 9, pairs, signs, 7).tolist()


@given(key=st.lists(words, min_size=4, max_size=4), coordinate=words)
def test_numpy_equals_the_reference(key, coordinate):
    key_words, at = np.array(key, np.uint32), np.array([coordinate], np.uint32)
    assert normal_integers(np, key_words, at)[0] == reference.normal_integer(key, coordinate)
    assert uniforms(key_words, at)[0] == np.float32(reference.uniform(key, coordinate))


def test_xla_equals_numpy_bit_for_bit():
    keys = stream_keys(11, Domain.PARAMETER_NOISE, 4, np.arange(64))
    compiled = jax.jit(jax.vmap(lambda key: (normal_integers(jnp, key, COORDINATES), uniforms(key, COORDINATES))))
    integers, fractions = compiled(keys)
    for row, key in enumerate(keys):
        np.testing.assert_array_equal(np.asarray(integers[row]), normal_integers(np, key, COORDINATES))
        np.testing.assert_array_equal(np.asarray(fractions[row]), uniforms(key, COORDINATES))


def test_normal_integers_are_odd_and_fit_in_int8_and_bfloat16():
    extremes = np.array([8 * 62 + 2 * 3 - 251, -251])
    seen = normal_integers(np, stream_keys(0, Domain.PARAMETER_NOISE, 0), np.arange(10**6, dtype=np.uint32))
    for k in (seen, extremes):
        assert np.all(k % 2 == 1)
        assert np.array_equal(((k - 1) // 2).astype(np.int8).astype(int) * 2 + 1, k)
        assert np.array_equal(np.asarray(jnp.asarray(k, jnp.bfloat16).astype(jnp.int32)), k)


def _population(domain: Domain, pairs: int = 1000) -> np.ndarray:
    keys = stream_keys(5, domain, 17, np.arange(pairs))
    return np.stack([normal_integers(np, key, COORDINATES) for key in keys]) / NORMAL_STD


# Statistical bounds are five standard errors. Nothing here is random, so a test that passes once always does.


def test_moments():
    x = _population(Domain.PARAMETER_NOISE).ravel()
    n = x.size
    assert abs(x.mean()) < 5 / np.sqrt(n)
    assert abs(x.var() - 1) < 5 * np.sqrt(2 / n)
    assert abs((x**3).mean()) < 5 * np.sqrt(15 / n)
    assert abs((x**4).mean() - (3 - 0.03197)) < 5 * np.sqrt(96 / n)


def test_distribution_is_the_binomial_with_dither_it_says_it_is():
    k = (_population(Domain.PARAMETER_NOISE) * NORMAL_STD).round().astype(int).ravel()
    values = np.arange(-251, 252, 2)
    expected = scipy.stats.binom(62, 0.5).pmf((values + 251) // 8) / 4 * k.size
    observed = np.array([np.count_nonzero(k == value) for value in values])
    tails = expected < 20
    observed = np.append(observed[~tails], observed[tails].sum())
    expected = np.append(expected[~tails], expected[tails].sum())
    assert scipy.stats.chisquare(observed, expected).pvalue > 1e-6


def test_tails_follow_the_normal_to_four_standard_deviations():
    x = _population(Domain.PARAMETER_NOISE)
    for bound in (2.0, 3.0, 4.0):
        share = 0.5 * (np.mean(x > bound) + np.mean(x < -bound))
        assert share == pytest.approx(scipy.stats.norm.sf(bound), rel=0.25)


def test_no_correlation_across_coordinates_pairs_generations_domains_seeds():
    x = _population(Domain.PARAMETER_NOISE)
    other_domain = _population(Domain.ACTION_NOISE)
    keys = {
        "generation": stream_keys(5, Domain.PARAMETER_NOISE, 18, np.arange(1000)),
        "seed": stream_keys(6, Domain.PARAMETER_NOISE, 17, np.arange(1000)),
    }
    others = {name: np.stack([normals(key, 4482) for key in k]) for name, k in keys.items()}
    products = {
        "neighbouring coordinates": x[:, :-1] * x[:, 1:],
        "coordinates a layer apart": x[:, :-64] * x[:, 64:],
        "neighbouring pairs": x[:-1] * x[1:],
        "domains": x * other_domain,
        **{name: x * other for name, other in others.items()},
    }
    for name, product in products.items():
        assert abs(product.mean()) * np.sqrt(product.size) < 5, name
        squares = (product**2).mean() - 1
        assert abs(squares) * np.sqrt(product.size / 8) < 5, name
    between_pairs = (x @ x.T / np.sqrt(x.shape[1]))[np.triu_indices(len(x), 1)]
    assert np.abs(between_pairs).max() < 6.0
    assert between_pairs.std() == pytest.approx(1.0, abs=0.01)


def test_every_layer_and_every_pair_has_its_own_noise():
    """The fault this guards: one key for every layer, so that equal-shaped layers get identical perturbations."""
    x = _population(Domain.PARAMETER_NOISE, pairs=50)
    biases_1, biases_2 = x[:, 128:192], x[:, 4288:4352]
    assert not np.any(np.all(biases_1 == biases_2, axis=1))
    assert len(np.unique(x, axis=0)) == 50


def test_uniforms_are_uniform():
    u = np.concatenate([uniforms(key, COORDINATES) for key in stream_keys(0, Domain.TRAINING_RESET, 1, np.arange(500))])
    assert u.min() >= 0.0
    assert u.max() < 1.0
    assert scipy.stats.kstest(u, "uniform").pvalue > 1e-6
    assert abs(np.mean((u[:-1] - 0.5) * (u[1:] - 0.5))) * 12 * np.sqrt(u.size) < 5


def test_flipping_any_address_bit_flips_half_of_the_hashed_bits():
    base = stream_keys(0, Domain.PARAMETER_NOISE, 0, 0)
    for field in range(3):
        for bit in range(0, 63, 7):
            address = [0, 0, 0]
            address[field] = 1 << bit
            seed, generation, pair = address
            flipped = np.bitwise_count(base ^ stream_keys(seed, Domain.PARAMETER_NOISE, generation, pair)).sum()
            assert 36 <= flipped <= 92  # 64 of 128 bits, five standard deviations
