# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The parameter keyframes_file: which layer is read; a bad layer does not stop the node."""

import logging

import pytest
from scene import make_layer, make_room, write_map

from cliploc_ros.core.keyframes.layer import layer_path, save_layer
from cliploc_ros.ros.frame_localizer import load_keyframes
from cliploc_ros.ros.parameters import RelocalizerParameters

ROOM = make_room()


@pytest.fixture
def room(tmp_path):
    """Write a map with a layer next to it."""
    path = tmp_path / 'room.yaml'
    write_map(ROOM, path)
    save_layer(layer_path(path), make_layer(ROOM))
    return path


def load(map_file, keyframes_file='auto'):
    return load_keyframes(RelocalizerParameters(
        map_file=str(map_file), keyframes_file=str(keyframes_file)), ROOM)


def test_the_layer_next_to_the_map_or_a_named_one_is_read_where_it_is_wanted(room, tmp_path):
    assert len(load(room).localizer.layer) == 6
    assert load(room, '') is load('') is None
    moved = tmp_path / 'other.npz'
    (tmp_path / 'room.keyframes.npz').rename(moved)
    assert load(room) is None
    assert len(load(room, moved).localizer.layer) == len(load('', moved).localizer.layer) == 6


@pytest.mark.parametrize('spoil', ['truncated', 'missing'])
def test_a_bad_layer_is_logged_and_left_out(room, caplog, spoil):
    layer = room.with_name('room.keyframes.npz')
    named = 'auto'
    if spoil == 'truncated':
        layer.write_bytes(layer.read_bytes()[:300])
    else:
        named = room.with_name('none.npz')
    with caplog.at_level(logging.ERROR):
        assert load(room, named) is None
    assert 'without keyframes' in caplog.text
    assert str(layer if spoil == 'truncated' else named) in caplog.text
