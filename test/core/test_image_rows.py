# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One row for each landmark, made of its label and its images."""

from dataclasses import replace

import numpy as np
import pytest

from cliploc_ros.core.map.landmark_embeddings import LandmarkEmbeddings, with_images
from cliploc_ros.core.map.similarities import (
    CropSimilarities,
    LabelEmbeddings,
    nearest_landmarks,
)

COUNT, SIZE = 50, 64


def units(rng, rows) -> np.ndarray:
    rows = np.asarray(rows) if np.ndim(rows) else rng.normal(size=(rows, SIZE))
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


@pytest.fixture
def world(rng):
    """Labels, images and crops of one space: labels and images lie apart, as those of CLIP."""
    objects, gap = units(rng, COUNT), units(rng, 2)
    labels = units(rng, gap[0] + 0.25 * objects)
    means = units(rng, gap[1] + objects)
    crops = units(rng, gap[1] + objects + 0.06 * rng.normal(size=objects.shape))
    images = LandmarkEmbeddings('key', tuple(map(str, range(COUNT))), means.astype(np.float16),
                                np.zeros((0, SIZE), np.float16), np.zeros(COUNT + 1, np.int64))
    return LabelEmbeddings.of(labels), images, crops


def top_1(rows, crops) -> float:
    found, _ = nearest_landmarks(CropSimilarities(crops, rows), 1)
    return float((found[:, 0] == np.arange(len(crops))).mean())


def test_images_alone_are_the_images(world):
    labels, images, _ = world
    assert np.array_equal(np.asarray(with_images(labels, images, 'image')), images.means)


def test_labels_and_images_spread_alike(world):
    labels, images, crops = world
    both = crops @ np.asarray(with_images(labels, images, 'both')).T
    with_labels, with_means = crops @ labels.unique.T, crops @ images.means.T
    share = np.linalg.lstsq(np.stack([with_labels.ravel(), with_means.ravel()], axis=1),
                            both.ravel(), rcond=None)[0]
    assert share.sum() == pytest.approx(1.0, abs=1e-3)  # a weighted mean of two cosines
    alone = np.array([with_labels.std(axis=1).mean(), with_means.std(axis=1).mean()])
    assert alone[1] > 1.8 * alone[0]
    spreads = share * alone
    assert 0.6 < spreads[0] / spreads[1] < 1.6
    assert np.abs(both).max() <= 1.0


@pytest.mark.parametrize('compare', ['image', 'both'])
def test_a_landmark_without_images_keeps_its_label(world, compare):
    labels, images, crops = world
    means = images.means.copy()
    means[:10] = 0.0
    rows = with_images(labels, replace(images, means=means), compare)
    similarities = crops @ np.asarray(rows).T
    known, unknown = similarities[:, 10:], similarities[:, :10]
    # neither the best nor the worst of all crops because it has no images
    assert abs(unknown.mean() - known.mean()) < similarities.std(axis=1).mean()
    own = np.arange(10)
    assert (np.argmax(unknown[own], axis=1) == own).mean() > 0.8
    assert top_1(rows, crops) > 0.7


def test_landmarks_that_share_a_label_differ_by_their_images(world):
    labels, images, crops = world
    shared = LabelEmbeddings(labels.unique[:1], np.zeros(COUNT, dtype=np.int64))
    assert top_1(shared, crops) <= 2 / COUNT
    for compare in ('image', 'both'):
        assert top_1(with_images(shared, images, compare), crops) > 0.9
