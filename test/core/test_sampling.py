# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
from math import comb

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cliploc_ros.core.search.strategies import draw_prosac, draw_ransac, prosac_growth


def test_growth_of_chum_and_matas():
    assert prosac_growth(33, 500)[:8].tolist() == [1, 2, 3, 4, 6, 8, 11, 15]


@given(st.integers(3, 200), st.integers(1, 5000))
def test_growth_is_monotone_and_ends_near_the_iterations(candidates, iterations):
    growth = prosac_growth(candidates, iterations)
    assert len(growth) == candidates - 2
    assert growth[0] == 1
    assert (np.diff(growth) >= 1).all()
    # from T_3 to T_N, with every step rounded up
    first = iterations / comb(candidates, 3)
    assert iterations - first <= growth[-1] - 1 + 1e-6 <= iterations - first + candidates


pairs = st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), min_size=0, max_size=30,
                 unique=True).map(lambda rows: np.array(rows, dtype=np.int64).reshape(-1, 2))


@given(pairs, st.integers(1, 200), st.integers(0, 2**32), st.sampled_from([draw_ransac,
                                                                           draw_prosac]))
def test_samples_are_valid_and_repeat(pairs, iterations, seed, draw):
    samples = draw(pairs, iterations, np.random.default_rng(seed))
    assert samples.shape == (iterations, 3)
    assert (samples == draw(pairs, iterations, np.random.default_rng(seed))).all()
    for sample in samples[samples[:, 0] >= 0]:
        assert len(set(pairs[sample, 0])) == 3
        assert len(set(pairs[sample, 1])) == 3


def test_prosac_draws_the_newest_candidate_while_its_set_grows():
    pairs = np.stack([np.arange(33)] * 2, axis=1)
    samples = draw_prosac(pairs, 500, np.random.default_rng(0))
    sizes = np.searchsorted(prosac_growth(33, 500), np.arange(1, 501)) + 3
    for sample, size in zip(samples, np.minimum(sizes, 33), strict=True):
        assert sample.max() == size - 1 if size < 33 else sample.max() < 33


def test_ransac_draws_all_candidates_alike():
    pairs = np.stack([np.arange(10)] * 2, axis=1)
    counts = np.bincount(draw_ransac(pairs, 30_000, np.random.default_rng(0)).ravel())
    # 9,000 each is expected, with a standard deviation of about 80
    assert np.abs(counts - 9_000).max() < 400
