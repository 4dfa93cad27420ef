# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several labels of a landmark make one embedding."""

from itertools import chain

import numpy as np
import pytest

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.models import label_embeddings
from cliploc_ros.models.label_embeddings import mixed_rows

AXES = {'a': [1.0, 0, 0], 'b': [0, 1.0, 0], 'c': [0, 0.6, 0.8]}


def encode(labels):
    return np.array([AXES[label] for label in labels], dtype=np.float32)


def test_the_weighted_mean_in_numbers():
    rows = mixed_rows([(('a', 3.0), ('b', 4.0)), (('c', 0.2),), (('b', 1.0), ('c', 1.0))],
                      encode, 3)
    assert rows.dtype == np.float32
    assert rows[0] == pytest.approx([0.6, 0.8, 0.0])
    assert np.array_equal(rows[1], encode('c')[0])  # to the last bit
    assert rows[2] == pytest.approx(np.array([0.0, 1.6, 0.8]) / np.sqrt(3.2))


def test_each_label_is_encoded_once_and_parts_change_nothing(monkeypatch):
    rng = np.random.default_rng(0)
    descriptions = [tuple((f'{number:03d}', float(weight)) for number, weight in zip(
        rng.choice(100, 6, replace=False), rng.uniform(0.1, 1, 6), strict=True))
        for _ in range(70)]
    embeddings = {f'{number:03d}': row for number, row in enumerate(
        rng.normal(size=(100, 8)).astype(np.float32))}
    asked = []

    def encode_some(labels):
        asked.append(list(labels))
        return np.array([embeddings[label] for label in labels])

    whole = mixed_rows(descriptions, encode_some, 8)
    monkeypatch.setattr(label_embeddings, 'PART', 16)
    monkeypatch.setattr(label_embeddings, '_BLOCK', 32)
    assert mixed_rows(descriptions, encode_some, 8) == pytest.approx(whole, abs=1e-6)
    assert max(map(len, asked[1:])) == 16
    assert list(chain(*asked[1:])) == asked[0] == sorted(set(asked[0]))
    assert np.linalg.norm(whole, axis=1) == pytest.approx(1.0, abs=1e-6)


def test_no_labels():
    assert mixed_rows([], encode, 3).shape == (0, 3)


def test_a_label_beside_the_list_counts_like_the_best():
    """As a name that a person gave a landmark which build_map had described."""
    one = LandmarkDetails(labels=(('a red mug', 0.5), ('a cup', 0.2)))
    assert one.labels_with('a cup') == one.labels
    assert one.labels_with('my mug') == (('my mug', 0.5), *one.labels)
    assert LandmarkDetails().labels_with('my mug') == (('my mug', 1.0),)
