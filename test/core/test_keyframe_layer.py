# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The layer's file: it comes back as it was, and bad files are named."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scene import CAMERA, make_layer, make_room

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.keyframes import layer as layers
from cliploc_ros.core.keyframes.layer import (
    layer_path,
    load_layer_of_map,
    save_layer,
)
from cliploc_ros.errors import MapError

ROOM = make_room()
KEYFRAMES, POINTS = 6, 40


@pytest.fixture
def file(tmp_path):
    path = layer_path(tmp_path / 'room.yaml')
    save_layer(path, make_layer(ROOM))
    return path


def rewrite(path, header=None, **changes):
    """Write the file again with other arrays, without those that are None, with another header."""
    with np.load(path) as content:
        arrays = {name: content[name] for name in content.files} | changes
    if header:
        arrays['header'] = np.array(json.dumps(json.loads(str(arrays['header'])) | header))
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})


def test_a_layer_comes_back_as_it_was(file):
    assert file.name == 'room.keyframes.npz'
    before, after = make_layer(ROOM), load_layer_of_map(file, ROOM)
    assert after.camera == before.camera
    assert after.landmark_ids == before.landmark_ids
    for name in ('map_from_camera', 'offsets', 'pixels', 'points', 'descriptors', 'words',
                 'vocabulary'):
        assert np.array_equal(getattr(after, name), getattr(before, name)), name
    assert not isinstance(after.descriptors, np.memmap), 'a small file may be written over'


def test_the_arrays_of_a_large_file_stay_in_it(file, monkeypatch):
    monkeypatch.setattr(layers, '_SCHEMA', replace(layers._SCHEMA, largest_read=0))
    layer = load_layer_of_map(file, ROOM)
    assert isinstance(layer.descriptors, np.memmap)
    assert np.array_equal(layer.descriptors, make_layer(ROOM).descriptors)


def test_an_edited_map_keeps_its_layer(file):
    fewer = ROOM.select(range(1, len(ROOM)))
    moved = replace(fewer, centers=fewer.centers + np.eye(len(fewer))[:, :1] * 3.0)
    assert len(load_layer_of_map(file, moved)) == KEYFRAMES


def test_the_most_similar_keyframe_has_the_same_words():
    layer = make_layer(ROOM)
    for keyframe in range(KEYFRAMES):
        similarities = layer.similarities(layer.unit_descriptors(keyframe))
        assert similarities.argmax() == keyframe


@pytest.mark.parametrize(('other', 'message'), [
    (replace(ROOM, frame_id='odom'), "'map', not 'odom'"),
    (replace(ROOM, landmark_ids=tuple(f'x{row}' for row in range(len(ROOM)))), 'no landmark'),
    (replace(ROOM, centers=ROOM.centers + 5.0), '8.66 m from')])
def test_the_layer_of_another_map_is_named(file, other, message):
    with pytest.raises(MapError, match=message) as caught:
        load_layer_of_map(file, other)
    assert str(file) in str(caught.value)


@pytest.mark.parametrize(('changes', 'message'), [
    ({'header': {'version': 2}}, 'version 2'), ({'header': {'descriptors': 'orb-32'}}, 'orb-32'),
    ({'header': {'camera': 7}}, 'camera'), ({'points': None}, 'points'),
    ({'points': np.zeros((3, 3), np.float32)}, r'points has shape'),
    ({'offsets': np.zeros(KEYFRAMES + 1, np.int64)}, 'offsets'),
    ({'map_from_camera': np.full((KEYFRAMES, 4, 4), np.nan)}, 'in row 0'),
    ({'words': np.full(KEYFRAMES * POINTS, 60_000, np.uint16)}, 'words')])
def test_malformed_files_are_named(file, changes, message):
    rewrite(file, **changes)
    with pytest.raises(MapError, match=message):
        load_layer_of_map(file, ROOM)


def test_random_damage_ends_in_an_error_or_in_a_layer(file):
    content, rng = bytearray(file.read_bytes()), np.random.default_rng(1)
    for _ in range(100):
        damaged = content.copy()
        for place in rng.integers(len(content), size=20):
            damaged[place] = rng.integers(256)
        file.write_bytes(damaged)
        try:
            layer = load_layer_of_map(file, ROOM)
        except MapError:
            continue
        assert layer.offsets[-1] == len(layer.descriptors)


def test_a_missing_or_compressed_file_and_a_failed_write_are_named(file, tmp_path):
    with pytest.raises(MapError, match='no such file'):
        load_layer_of_map(tmp_path / 'none.npz', ROOM)
    with np.load(file) as content:
        np.savez_compressed(file, **{name: content[name] for name in content.files})
    with pytest.raises(MapError, match='compressed'):
        load_layer_of_map(file, ROOM)
    with pytest.raises(MapError, match='cannot be written'):
        save_layer(tmp_path / 'missing' / 'room.npz', make_layer(ROOM))


def test_another_camera_is_noted():
    layer = make_layer(ROOM)
    assert layer.camera_note(CAMERA) == ''
    assert layer.camera_note(Camera(1280, 960, 1000.0, 1000.0, 640.0, 480.0)) == ''
    assert 'fx 700.0' in layer.camera_note(Camera(640, 480, 700.0, 700.0, 320.0, 240.0))
