# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The nearest landmarks, block by block, against a sort of everything."""


import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cliploc_ros.core.map.similarities import (
    CropSimilarities,
    LabelEmbeddings,
    nearest_landmarks,
)
from cliploc_ros.errors import OptionsError


def units(rng, count, size=16):
    rows = rng.standard_normal((count, size), dtype=np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def sorted_whole(similarities, k):
    order = np.argsort(-similarities, axis=1, kind='stable')[:, :k]
    return order, np.take_along_axis(similarities, order, axis=1)


@pytest.mark.parametrize('landmarks', [1, 40, 2048, 2049, 9_000])
def test_nearest_are_those_of_a_whole_sort(rng, landmarks):
    similarities = rng.random((5, landmarks), dtype=np.float32).round(2)  # with many equals
    k = min(landmarks, 7)
    found, values = nearest_landmarks(similarities, k)
    wanted, best = sorted_whole(similarities, k)
    assert (found == wanted).all()
    assert (values == best).all()


@given(st.integers(1, 12), st.integers(1, 40), st.integers(0, 2**32 - 1), st.data())
def test_a_shared_label_counts_for_each_landmark(labels, landmarks, seed, data):
    rng = np.random.default_rng(seed)
    used, of_landmarks = np.unique(rng.integers(0, labels, landmarks), return_inverse=True)
    embeddings = LabelEmbeddings(units(rng, len(used)), of_landmarks)
    similarities = CropSimilarities(units(rng, 4), embeddings)
    k = data.draw(st.integers(1, landmarks))
    found, values = nearest_landmarks(similarities, k)
    assert similarities.shape == (4, landmarks)
    wanted, best = sorted_whole(np.asarray(similarities), k)
    assert (found == wanted).all()
    np.testing.assert_allclose(values, best, atol=1e-6)


def test_what_is_not_finite_is_refused():
    similarities = np.zeros((2, 3_000), dtype=np.float32)
    similarities[1, 2_999] = np.nan
    with pytest.raises(OptionsError, match='not finite'):
        nearest_landmarks(similarities, 3)
