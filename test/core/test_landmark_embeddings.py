# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The file of landmark embeddings: what it holds, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from cliploc_ros.core.map.landmark_embeddings import (
    LandmarkEmbeddings,
    embeddings_path,
    load_embeddings_of_map,
    load_landmark_embeddings,
    save_landmark_embeddings,
)
from cliploc_ros.errors import MapError


def unit_rows(count, seed):
    rows = np.random.default_rng(seed).normal(size=(count, 8))
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float16)


@pytest.fixture
def embeddings():
    """Return three landmarks: two medoids, none and unknown, one."""
    means = unit_rows(3, 0)
    means[1] = 0.0
    return LandmarkEmbeddings('tiny:gelu:1234', ('mug_1', 'mug_2', 'book_1'), means,
                              unit_rows(3, 1), np.array([0, 2, 2, 3]))


def arrays_of(embeddings):
    return {name: np.array(value) for name, value in vars(embeddings).items()}


def test_a_file_comes_back_as_it_was_written(tmp_path, embeddings):
    path = embeddings_path(tmp_path / 'my.office.yaml')
    assert path.name == 'my.office.embeddings.npz'
    save_landmark_embeddings(path, embeddings)
    found = load_landmark_embeddings(path)
    assert found.encoder_key == embeddings.encoder_key
    assert found.landmark_ids == embeddings.landmark_ids
    for name in ('means', 'medoids', 'medoid_offsets'):
        np.testing.assert_array_equal(getattr(found, name), getattr(embeddings, name))
    assert found.is_known.tolist() == [True, False, True]
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_rows_take_the_order_of_a_map(embeddings):
    ordered = embeddings.in_order(['book_1', 'new', 'mug_1'])
    assert ordered.landmark_ids == ('book_1', 'new', 'mug_1')
    assert ordered.is_known.tolist() == [True, False, True]
    np.testing.assert_array_equal(ordered.means[[0, 2]], embeddings.means[[2, 0]])
    assert ordered.medoid_offsets.tolist() == [0, 1, 1, 3]
    np.testing.assert_array_equal(ordered.medoids, embeddings.medoids[[2, 0, 1]])
    assert embeddings.in_order([]).medoid_offsets.tolist() == [0]


def test_a_map_finds_the_file_next_to_it(tmp_path, embeddings):
    map_path = tmp_path / 'office.yaml'
    assert load_embeddings_of_map(map_path, ['mug_1']) is None
    save_landmark_embeddings(embeddings_path(map_path), embeddings)
    found = load_embeddings_of_map(map_path, ['added', 'mug_1'])
    assert found.is_known.tolist() == [False, True]
    with pytest.raises(MapError, match='another map'):
        load_embeddings_of_map(map_path, ['chair_1'])


WRONG = {
    'wrong rows': ('means', unit_rows(2, 0), r'means has shape \(2, 8\)'),
    'repeated id': ('landmark_ids', np.array(['a', 'b', 'a']), 'repeats an id'),
    'NaN': ('means', np.full((3, 8), np.nan), 'unit length in row 0'),
    'end': ('medoid_offsets', np.array([0, 1, 2, 2]), 'medoid_offsets goes from 0 to 2'),
    'falling': ('medoid_offsets', np.array([0, 3, 2, 3]), 'medoid_offsets decreases')}


@pytest.mark.parametrize(('name', 'value', 'message'), WRONG.values(), ids=WRONG)
def test_a_malformed_array_is_refused(tmp_path, embeddings, name, value, message):
    arrays = arrays_of(embeddings) | {name: value}
    path = tmp_path / 'wrong.npz'
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(MapError, match=message):
        load_landmark_embeddings(path)


def test_a_failed_write_keeps_the_old_file(tmp_path, embeddings):
    path = tmp_path / 'office.embeddings.npz'
    save_landmark_embeddings(path, embeddings)
    with pytest.raises(MapError, match='nothing was changed'):
        save_landmark_embeddings(tmp_path / 'no_folder' / 'x.npz', embeddings)
    with pytest.raises(MapError, match='not of unit length'):
        save_landmark_embeddings(path, replace(embeddings, means=embeddings.means * 2))
    assert load_landmark_embeddings(path).landmark_ids == embeddings.landmark_ids
