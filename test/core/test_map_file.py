# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Writing maps, and the optional fields of a map file."""

from dataclasses import fields, replace

import numpy as np
import pytest
import yaml
from scene import make_room

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_embeddings import (
    LandmarkEmbeddings,
    embeddings_path,
    load_embeddings_of_map,
)
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.core.map.parameter_file import parse_written_map, read_parameter_file
from cliploc_ros.errors import MapError

CUP = {'class_id': 'cup', 'center': [1.0, 2.0, 3.0], 'semi_axes': [0.1, 0.2, 0.3],
       'orientation': [0.0, 0.0, 0.0, 1.0]}
FULL = LandmarkDetails(
    labels=(('a "red" cup: with #', 0.75), ('a mug', 0.25)),
    class_weights=(('cup', 0.9), ('wine glass', 0.1)), position_sigma=0.0125,
    shared_sigma=0.0175, shared_sigma_deg=0.375, support=37,
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


@pytest.mark.parametrize('label', ['a 😀 cup', 'Käfer ☕', '\\ud83d\\ude00', 'a\u2028b "\\'])
def test_any_text_is_read_back(tmp_path, label):
    room = make_room()
    write_map(tmp_path / 'map.yaml', replace(room, labels=(label, *room.labels[1:])))
    assert LandmarkMap.from_file(tmp_path / 'map.yaml').labels[0] == label
    tree = read_parameter_file(tmp_path / 'map.yaml')['/**']['ros__parameters']['map']
    assert tree['landmarks'][room.landmark_ids[0]]['label'] == label


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


def test_a_link_stays_and_the_file_it_leads_to_keeps_its_mode(tmp_path):
    (tmp_path / 'maps').mkdir()
    there, link = tmp_path / 'maps/office.yaml', tmp_path / 'map.yaml'
    link.symlink_to('maps/office.yaml')
    write_map(link, make_room())  # a link may lead to a file that is yet to be made
    there.chmod(0o640)
    there.write_text('old')
    write_map(link, make_room())
    assert link.is_symlink() and there.stat().st_mode & 0o777 == 0o640
    assert LandmarkMap.from_file(there).landmark_ids == make_room().landmark_ids
    assert sorted(file.name for file in tmp_path.rglob('*')) == ['map.yaml', 'maps', 'office.yaml']


def test_image_embeddings_belong_to_one_map(tmp_path):
    path, room = tmp_path / 'map.yaml', make_room()
    rows = np.eye(12, 16, dtype=np.float16)
    seen = LandmarkEmbeddings('key', room.landmark_ids, rows, rows, np.arange(13))
    write_map(path, room, embeddings=seen)
    assert load_embeddings_of_map(path, room.landmark_ids).is_known.all()
    write_map(path, room)
    assert load_embeddings_of_map(path, room.landmark_ids) is None
    embeddings_path(path).mkdir()
    with pytest.raises(MapError, match='cannot be removed'):
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
    ({'labels': {'text': ['a'], 'weight': [1.0, 2.0]}}, 'equal length'),
    ({'labels': [{'text': 'a', 'weight': 0.0}]}, 'above 0'),
    ({'label': 'a', 'class_weights': ['cup']}, 'class_weights'),
    ({'label': 'a', 'position_sigma': float('nan')}, 'position_sigma: nan'),
    ({'label': 'a', 'seen_ratio': -0.5}, 'seen_ratio: -0.5')])
def test_refuses_wrong_details(fields, message):
    with pytest.raises(MapError, match=message):
        read(CUP | fields)


def by_yaml(path):
    tree = read_parameter_file(path)['/**']['ros__parameters']['map']
    return LandmarkMap.from_mapping(tree, str(path))


def equal(one, other):
    return all(np.array_equal(getattr(one, field.name), getattr(other, field.name))
               if field.name in ('centers', 'semi_axes', 'quats_xyzw')
               else getattr(one, field.name) == getattr(other, field.name)
               for field in fields(LandmarkMap))


@pytest.mark.parametrize('details', [
    (), (FULL,) * 12, (LandmarkDetails(), FULL) * 6,
    (LandmarkDetails(shared_sigma=0.02, shared_sigma_deg=0.5, support=3, last_seen=5.0),) * 12])
@pytest.mark.parametrize('label', ['a mug', 'caf\u00e9 "x" \\ #1: [a]', 'tab\tand\nline', '\x7f'])
def test_what_was_written_is_read_as_yaml_reads_it(tmp_path, details, label):
    path, room = tmp_path / 'map.yaml', make_room()
    write_map(path, replace(room, details=details, labels=(label, *room.labels[1:])), ['h\u00f6'])
    assert parse_written_map(path.read_text(encoding='utf-8')) is not None
    assert equal(LandmarkMap.from_file(path), by_yaml(path))


@pytest.mark.parametrize(('before', 'after'), [
    ('center: [', 'center: [0'), ('0.', '.'), ('label: "', 'label: '),
    ('semi_axes: [0', 'semi_axes: [-0'), ('semi_axes: [0', 'semi_axes: [1e9'),
    ('support: 37', 'support: 37.5'), ('support: 37', 'support: -37'), ('"cup": ', '"c\\ud83d": '),
    ('position_sigma: 0.0125', 'position_sigma: .nan'), ('    text: [', '    text: ["one more", '),
    ('0.7500', '0.0000'), ('source: "build', 'source: "  " #'), ('label: "', 'label: "\\x41'),
    ('frame_id: "', 'frame_id: "" #'), ('orientation: [', 'orientation: [9'), ('\n', '\r\n'),
    ('          label', '\t  label'), ('landmarks:', 'landmarks: # all'),
    ('class_id: "', "class_id: '")])
def test_a_changed_file_is_read_or_refused_as_by_yaml(tmp_path, before, after):
    path = tmp_path / 'map.yaml'
    write_map(path, replace(make_room(), details=(FULL,) * 12))
    text = path.read_bytes().decode()
    assert before in text
    path.write_bytes(text.replace(before, after, 1).encode())
    try:
        expected = by_yaml(path)
    except MapError as error:
        with pytest.raises(MapError) as raised:
            LandmarkMap.from_file(path)
        assert str(raised.value) == str(error)
    else:
        assert equal(LandmarkMap.from_file(path), expected)
