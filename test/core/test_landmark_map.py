# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import os

import numpy as np
import pytest
import yaml

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import MapError

CUP = {'label': 'a red cup', 'class_id': 'cup', 'center': [1.0, 2.0, 3.0],
       'semi_axes': [0.1, 0.2, 0.3], 'orientation': [0.0, 0.0, 0.0, 1.0]}


def file_of(landmarks, frame_id='map'):
    return {'/**': {'ros__parameters': {'map': {'frame_id': frame_id, 'landmarks': landmarks}}}}


def write(tmp_path, content):
    path = tmp_path / 'map.yaml'
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


def test_reads_every_field(tmp_path):
    loaded = LandmarkMap.from_file(write(tmp_path, file_of({'cup_1': CUP})))
    assert (loaded.frame_id, loaded.landmark_ids, loaded.labels, loaded.class_ids) == (
        'map', ('cup_1',), ('a red cup',), ('cup',))
    assert loaded.centers.tolist() == [[1.0, 2.0, 3.0]]
    assert loaded.semi_axes.tolist() == [[0.1, 0.2, 0.3]]
    assert loaded.shapes[0] == pytest.approx([0.01, 0, 0, 0.04, 0, 0.09])


def test_a_nearly_unit_quaternion_is_normalized(tmp_path):
    tilted = CUP | {'orientation': [0.0, 0.0, 0.7071, 0.7071]}
    loaded = LandmarkMap.from_file(write(tmp_path, file_of({'cup_1': tilted})))
    assert np.linalg.norm(loaded.quats_xyzw) == pytest.approx(1.0, abs=1e-12)
    assert loaded.shapes[0] == pytest.approx([0.04, 0, 0, 0.01, 0, 0.09])


@pytest.mark.parametrize(('change', 'message'), [
    ({'center': [float('nan'), 0.0, 0.0]}, 'center: .*finite'),
    ({'center': [1e300, 0.0, 0.0]}, 'center: .*beyond'), ({'center': [0.0, 0.0]}, 'center: .*3'),
    ({'center': [True, 0.0, 0.0]}, 'center: .*3'), ({'semi_axes': [0.1, -1.0, 0.1]}, 'semi_axes'),
    ({'orientation': [0.0] * 4}, 'orientation: .*0'), ({'class_id': None}, 'class_id'),
    ({'colour': 'red'}, '.*colour')])
def test_bad_fields_are_named_with_file_and_landmark(tmp_path, change, message):
    path = write(tmp_path, file_of({'cup_1': CUP | change}))
    with pytest.raises(MapError, match=f"{path}: landmark 'cup_1': {message}"):
        LandmarkMap.from_file(path)


@pytest.mark.parametrize(('content', 'message'), [
    ('', 'no YAML mapping'), ('a: [1, 2', 'line 1, column 4'),
    ('a: &x [1]\nb: *x\n', 'an alias'), ('a: 1\na: 2\n', "'a' is repeated"),
    ('[' * 1_000_000, 'nest'),
    (b'\x7fELF\xff\xfe\x00', 'not a text file'),
    ('/**:\n  ros__parameters:\n    map:\n', 'frame_id, landmarks'),
    (file_of({}), 'the map is empty'), (file_of({'a.b': CUP}), 'without dots'),
    (file_of({'a': {'centre': 0, **CUP}}), "mean 'center'"),
    (file_of({'a': CUP}) | {'/x': {'ros__parameters': {'map': {}}}}, 'more than one map'),
    ('!!python/object/apply:os.system [echo]', 'no YAML mapping')])
def test_broken_and_hostile_files_are_refused(tmp_path, content, message):
    with pytest.raises(MapError, match=message):
        LandmarkMap.from_file(write(tmp_path, content))


def test_what_has_no_end_is_not_read(tmp_path):
    pipe = tmp_path / 'pipe'
    os.mkfifo(pipe)
    for path in ('/dev/zero', pipe, tmp_path):
        with pytest.raises(MapError, match='regular file'):
            LandmarkMap.from_file(path)
