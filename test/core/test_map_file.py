# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Writing maps, and the optional fields of a map file."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from scene import make_room

from cliploc_ros.core.maps.landmark_details import LandmarkDetails
from cliploc_ros.core.maps.landmark_embeddings import (
    LandmarkEmbeddings,
    embeddings_path,
    load_embeddings_of_map,
)
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.maps.map_file import write_map
from cliploc_ros.errors import MapError

CUP = {'class_id': 'cup', 'center': [1.0, 2.0, 3.0], 'semi_axes': [0.1, 0.2, 0.3],
       'orientation': [0.0, 0.0, 0.0, 1.0]}
FULL = LandmarkDetails(
    labels=(('a "red" cup: with #', 0.75), ('a mug', 0.25)),
    class_weights=(('cup', 0.9), ('wine glass', 0.1)), position_sigma=0.0125, support=37,
    seen_ratio=0.625, baseline_deg=71.5, last_seen=1341847980.75, source='build_map: office.npz')


def read(fields):
    return LandmarkMap.from_mapping({'frame_id': 'map', 'landmarks': {'cup_1': fields}}, 'here')


def test_a_written_map_is_read_back(tmp_path):
    room = make_room()
    room = replace(room, labels=('yes: "quoted" \\ #1', *room.labels[1:]),
                   details=(FULL,) + (LandmarkDetails(support=3),) * (len(room) - 1))
    write_map(tmp_path / 'map.yaml', room, ['two\nlines become one'])
    loaded = LandmarkMap.from_file(tmp_path / 'map.yaml')
    assert (loaded.frame_id, loaded.landmark_ids, loaded.labels, loaded.class_ids,
            loaded.details) == (room.frame_id, room.landmark_ids, room.labels, room.class_ids,
                                room.details)
    assert loaded.centers == pytest.approx(room.centers, abs=1e-5)
    assert loaded.semi_axes == pytest.approx(room.semi_axes, abs=1e-5)
    assert loaded.quats_xyzw == pytest.approx(room.quats_xyzw, abs=2e-5)


def test_tiny_weights_stay_above_zero(tmp_path):
    tiny = LandmarkDetails(labels=(('a cup', 1.0), ('a mug', 1e-9)),
                           class_weights=(('cup', 1.0), ('bowl', 1e-9)))
    write_map(tmp_path / 'map.yaml', replace(make_room(), details=(tiny,) * 12))
    loaded = LandmarkMap.from_file(tmp_path / 'map.yaml').details[0]
    assert 0.0 < loaded.labels[1][1] < 1e-3
    assert 0.0 < loaded.class_weights[1][1] < 1e-3


def test_a_map_without_details_has_none(tmp_path):
    write_map(tmp_path / 'map.yaml', make_room())
    assert LandmarkMap.from_file(tmp_path / 'map.yaml').details == ()


def test_every_number_of_a_list_is_a_float(tmp_path):
    # ROS refuses arrays that mix integers and floats
    write_map(tmp_path / 'map.yaml', replace(make_room(), centers=np.ones((12, 3))))
    tree = yaml.safe_load((tmp_path / 'map.yaml').read_text())
    for landmark in tree['/**']['ros__parameters']['map']['landmarks'].values():
        assert all(isinstance(value, float) for value in landmark['center'])


def test_the_old_map_stays_when_the_new_one_cannot_be_written(tmp_path):
    path = tmp_path / 'map.yaml'
    path.write_text('old')
    broken = replace(make_room(), centers=np.full((12, 3), 'x', dtype=object))
    with pytest.raises(ValueError):
        write_map(path, broken)
    assert path.read_text() == 'old'
    assert [file.name for file in tmp_path.iterdir()] == ['map.yaml']
    with pytest.raises(MapError, match='cannot be written'):
        write_map(tmp_path / 'missing' / 'map.yaml', make_room())


def test_image_embeddings_belong_to_one_map(tmp_path):
    path, room = tmp_path / 'map.yaml', make_room()
    rows = np.eye(12, 16, dtype=np.float16)
    seen = LandmarkEmbeddings('key', room.landmark_ids, rows, rows, np.arange(13))
    write_map(path, room, embeddings=seen)
    assert load_embeddings_of_map(path, room.landmark_ids).is_known.all()
    write_map(path, room)
    assert load_embeddings_of_map(path, room.landmark_ids) is None
    embeddings_path(path).mkdir()
    with pytest.raises(MapError, match=r'map\.embeddings\.npz: .*cannot be removed'):
        write_map(path, room)


def test_labels_may_stand_in_place_of_a_label():
    labels = {'text': ['a mug', 'a red cup'], 'weight': [0.25, 0.75]}
    landmark_map = read(CUP | {'labels': labels})
    assert landmark_map.labels == ('a red cup',)
    assert landmark_map.details[0].labels == (('a mug', 0.25), ('a red cup', 0.75))
    rows = [{'text': 'a mug', 'weight': 0.25}, {'text': 'a red cup', 'weight': 0.75}]
    assert read(CUP | {'labels': rows, 'label': 'mine'}).labels == ('mine',)
    assert read(CUP | {'labels': rows}).details == landmark_map.details


@pytest.mark.parametrize(('fields', 'message'), [
    ({'labels': []}, 'labels: is empty'),
    ({'labels': {'text': ['a'], 'weight': [1.0, 2.0]}}, 'two lists of equal length'),
    ({'labels': [{'text': 'a', 'weight': 0.0}]}, 'weights must be above 0'),
    ({'labels': [{'text': '', 'weight': 1.0}]}, 'must be text'),
    ({'label': 'a', 'class_weights': ['cup']}, 'class_weights: must map class names to weights'),
    ({'label': 'a', 'support': 'many'}, 'support: must be a number'),
    ({'label': 'a', 'position_sigma': float('nan')}, 'position_sigma: nan must be finite'),
    ({'label': 'a', 'seen_ratio': -0.5}, 'seen_ratio: -0.5 must be finite and not negative'),
    ({'label': 'a', 'source': 7}, 'source: must be text'),
    ({'label': 'a', 'colour': 'red'}, 'unknown field: colour'),
])
def test_refuses_wrong_details(fields, message):
    with pytest.raises(MapError, match=f"here: landmark 'cup_1': .*{message}|{message}"):
        read(CUP | fields)
