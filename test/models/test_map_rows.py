# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A map's labels and images with a real, small CLIP."""

from dataclasses import replace

import numpy as np
import pytest
from scene import make_room

from cliploc_ros.core.map.joined_map import join_maps
from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_embeddings import (
    LandmarkEmbeddings,
    embeddings_path,
    save_landmark_embeddings,
)
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.models.clip_weights import ClipOptions, resolve_clip_weights
from cliploc_ros.models.map_rows import embed_map, load_encoder_for_map

pytestmark = pytest.mark.full

ROOM = make_room()


@pytest.fixture(scope='module')
def clip(small_clip, tmp_path_factory):
    return ClipOptions(model=small_clip.name, pretrained=str(small_clip.file), device='cpu',
                       cache_dir=str(tmp_path_factory.mktemp('cache')), inference='pytorch')


@pytest.fixture
def map_file(tmp_path):
    write_map(tmp_path / 'room.yaml', ROOM)
    return tmp_path / 'room.yaml'


def images_of(key, ids=ROOM.landmark_ids, size=64):
    means = np.random.default_rng(0).normal(size=(len(ids), size))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    return LandmarkEmbeddings(key, tuple(ids), means.astype(np.float16),
                              np.zeros((0, size), np.float16), np.zeros(len(ids) + 1, np.int64))


def test_labels_with_weights_are_mixed(clip, small_clip):
    described = replace(ROOM, details=(
        LandmarkDetails(labels=((ROOM.labels[0], 3.0), ('a red cup', 1.0))),
        *[LandmarkDetails()] * (len(ROOM) - 1)))
    rows = np.asarray(embed_map(clip, described, [], 'both'))
    plain = np.asarray(embed_map(clip, ROOM, [], 'both'))
    assert np.array_equal(rows[1:], plain[1:])
    expected = np.array([3.0, 1.0]) @ small_clip.labels([ROOM.labels[0], 'a red cup'])
    assert rows[0] == pytest.approx(expected / np.linalg.norm(expected), abs=1e-5)


@pytest.mark.parametrize('compare', ['image', 'both'])
def test_images_of_this_encoder_are_compared(clip, map_file, compare):
    images = images_of(resolve_clip_weights(clip).key)
    save_landmark_embeddings(embeddings_path(map_file), images)
    plain = np.asarray(embed_map(clip, ROOM, [str(map_file)], 'text'))
    rows = np.asarray(load_encoder_for_map(clip, ROOM, [str(map_file)], compare).label_embeddings)
    assert np.array_equal(plain, np.asarray(embed_map(clip, ROOM, [], compare)))
    similar = np.sum(rows * images.means, axis=1)
    assert (similar > np.sum(plain * images.means, axis=1) + 0.2).all()
    if compare == 'image':
        assert np.array_equal(rows, images.means)
    # the order is that of the map, and landmarks that were added have their label
    fewer = images_of(images.encoder_key).in_order(ROOM.landmark_ids[:0:-1])
    save_landmark_embeddings(embeddings_path(map_file), fewer)
    again = np.asarray(embed_map(clip, ROOM, [str(map_file)], compare))
    assert np.isfinite(again).all()
    assert np.argmax(again[1:] @ images.means[1:].T, axis=1).tolist() == list(range(len(ROOM) - 1))


def test_images_of_several_maps_are_compared_together_or_not_at_all(clip, tmp_path, caplog):
    """Each map keeps rows of its own; a map without images has all maps compared by labels."""
    maps = [replace(ROOM, frame_id='hall'), replace(ROOM, frame_id='attic').select([2, 0, 1])]
    files = [str(tmp_path / f'{one.frame_id}.yaml') for one in maps]
    both = join_maps(maps, files)
    for one, file in zip(maps, files, strict=True):
        write_map(file, one)
        save_landmark_embeddings(embeddings_path(file), images_of(
            resolve_clip_weights(clip).key, one.landmark_ids))
    rows = embed_map(clip, both, files, 'image')
    expected = [images_of('', one.landmark_ids).means for one in maps]
    assert np.array_equal(np.asarray(rows), np.concatenate(expected))
    for part, own in zip(rows.parts, expected, strict=True):
        assert np.array_equal(np.asarray(part), own)
    embeddings_path(files[1]).unlink()
    plain = np.asarray(embed_map(clip, ROOM, [], 'text'))
    rows = embed_map(clip, both, files, 'image')
    assert np.array_equal(np.asarray(rows), plain[[*range(len(ROOM)), 2, 0, 1]])
    warning, = (one for one in caplog.records if one.levelname == 'WARNING')
    assert f'{files[1]} has no images' in warning.getMessage()
