# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The image embeddings next to a map follow their landmarks through edits and undo."""

import numpy as np
import pytest
from studio_map import TEXT

from cliploc_ros.core.map.landmark_embeddings import (
    LandmarkEmbeddings,
    embeddings_path,
    load_embeddings_of_map,
    load_landmark_embeddings,
    save_landmark_embeddings,
)
from cliploc_ros.offline.studio import edits
from cliploc_ros.offline.studio.document import Document

IDS = ('plant_1', 'gone_1', 'cup_1', 'book_1')  # not in the map's order, with one extra
SIZE = 16


def unit(rows):
    return (rows / np.linalg.norm(rows, axis=-1, keepdims=True)).astype(np.float16)


@pytest.fixture
def path(tmp_path):
    path = tmp_path / 'office.yaml'
    path.write_text(TEXT.replace('position_sigma: 0.01', 'support: 3'))
    rng = np.random.default_rng(0)
    save_landmark_embeddings(embeddings_path(path), LandmarkEmbeddings(
        'demo:key', IDS, unit(rng.normal(size=(4, SIZE))), unit(rng.normal(size=(16, SIZE))),
        np.array([0, 5, 7, 12, 16])))
    return path


@pytest.fixture
def rows(path):
    """Return the original mean and medoids by landmark."""
    return rows_of(path)


def rows_of(path):
    found = load_landmark_embeddings(embeddings_path(path))
    return {key: (found.means[row], found.medoids[slice(*found.medoid_offsets[row:row + 2])])
            for row, key in enumerate(found.landmark_ids)}


def is_equal(first, second):
    return all(np.array_equal(one, other) for one, other in zip(first, second, strict=True))


def change_all(document):
    document.edit(edits.merge, ['cup_1', 'book_1'])
    document.edit(edits.split, 'plant_1')
    document.edit(edits.create, 'new', 'book', np.ones(3), np.eye(3))


def check_all(path, rows):
    """A merged landmark has the weighted mean, each half the original rows, a new one none."""
    found = rows_of(path)
    assert sorted(found) == ['book_1', 'cup_1', 'plant_1', 'plant_2']
    mean = rows['cup_1'][0].astype(float) + 3.0 * rows['book_1'][0].astype(float)
    np.testing.assert_allclose(found['cup_1'][0], mean / np.linalg.norm(mean), atol=2e-3)
    both = np.concatenate([rows['cup_1'][1], rows['book_1'][1]])
    assert len(found['cup_1'][1]) == 5
    assert all((both == medoid).all(axis=1).any() for medoid in found['cup_1'][1])
    assert is_equal(found['plant_1'], rows['plant_1'])
    assert is_equal(found['plant_2'], rows['plant_1'])
    assert not found['book_1'][0].any() and not len(found['book_1'][1]), 'not the old book'
    known = load_embeddings_of_map(path, sorted(found)).is_known
    assert known.tolist() == [False, True, True, True]


def test_rows_follow_their_landmarks(path, rows):
    document = Document(path)
    change_all(document)
    assert is_equal(rows_of(path)['cup_1'], rows['cup_1']), 'only saving writes'
    document.save()
    check_all(path, rows)
    for _ in range(3):
        document.undo()
    document.save()
    found = rows_of(path)
    assert set(found) == {'cup_1', 'book_1', 'plant_1'}
    assert all(is_equal(found[key], rows[key]) for key in found)
    for _ in range(3):
        document.redo()
    document.save()
    check_all(path, rows)
    document.close()


def test_an_unusable_file_stays(path):
    embeddings_path(path).write_bytes(b'of another program')
    document = Document(path)
    assert any('npz file' in note for note in document.notes)
    document.edit(edits.delete, ['book_1'])
    document.save()
    document.close()
    assert embeddings_path(path).read_bytes() == b'of another program'
