# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import copy
import os

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from cliploc_ros.core.map import parameter_file
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
    ({'center': [float('nan'), 0.0, 0.0]}, 'center: .* not finite'),
    ({'center': [float('inf'), 0.0, 0.0]}, 'center: .* not finite'),
    ({'center': [1e300, 0.0, 0.0]}, 'center: .* beyond'),
    ({'center': [0.0, 0.0]}, 'center: must be 3 numbers'),
    ({'center': 'here'}, 'center: must be 3 numbers'),
    ({'center': [True, 0.0, 0.0]}, 'center: must be 3 numbers'),
    ({'center': None}, 'center: must be 3 numbers'),
    ({'semi_axes': [0.1, 0.0, 0.1]}, 'semi_axes: .* must be within'),
    ({'semi_axes': [0.1, -1.0, 0.1]}, 'semi_axes: .* must be within'),
    ({'semi_axes': [1e-300, 1.0, 0.1]}, 'semi_axes: .* must be within'),
    ({'orientation': [0.0, 0.0, 0.0, 2.0]}, 'orientation: .* norm 2, not 1'),
    ({'orientation': [0.0] * 4}, 'orientation: .* norm 0, not 1'),
    ({'label': ''}, 'label: must be non-empty text'),
    ({'label': 7}, 'label: must be non-empty text'),
    ({'label': 'x' * 100_000}, 'label: longer than'),
    ({'class_id': None}, 'class_id: must be non-empty text'),
    ({'colour': 'red'}, 'unknown field: colour'),
])
def test_bad_fields_are_named_with_file_and_landmark(tmp_path, change, message):
    path = write(tmp_path, file_of({'cup_1': CUP | change}))
    with pytest.raises(MapError, match=f"{path}: landmark 'cup_1': {message}"):
        LandmarkMap.from_file(path)


@pytest.mark.parametrize('field', CUP)
def test_missing_fields_are_named(tmp_path, field):
    landmark = {name: value for name, value in CUP.items() if name != field}
    with pytest.raises(MapError, match=f"landmark 'cup_1': missing field: {field}"):
        LandmarkMap.from_file(write(tmp_path, file_of({'cup_1': landmark})))


@pytest.mark.parametrize(('content', 'message'), [
    ('', 'no YAML mapping'),
    ('just text', 'no YAML mapping'),
    ('- a\n- b\n', 'no YAML mapping'),
    ('a: [1, 2', 'not valid YAML: [^<]* at line 1, column 4'),
    ('a: 1\n---\nb: 2\n', 'not valid YAML|more than one'),
    ('a: &x [1]\nb: *x\n', 'an alias'),
    ('a: 1\na: 2\n', "'a' is repeated"),
    ('{[1, 2]: 3}', 'a key must be a name'),
    ('[' * 1_000_000, 'nested deeper than|nesting depth'),  # PyYAML from 6.0.4
    ('{a: ' * 1_000_000, 'nested deeper than|nesting depth'),
    (b'\x7fELF\xff\xfe\x00', 'not a text file'),
    ('a: 1\n', 'no map'),
    ('/**:\n  ros__parameters:\n    map:\n', 'expected the fields frame_id, landmarks'),
    (file_of({}), 'the map is empty'),
    (file_of([1, 2]), 'the map is empty'),
    (file_of({'a.b': CUP}), 'without dots'),
    (file_of({'a': CUP}, ''), 'frame_id: must be non-empty text'),
    (file_of({'a': 'cup'}), "landmark 'a': expected the fields"),
    (file_of({'a': {'centre': 0, **CUP}}), r"unknown field: centre \(did you mean 'center'\?\)"),
    (file_of({'a': CUP}) | {'/x': {'ros__parameters': {'map': {}}}}, 'more than one map'),
    ('!!python/object/apply:os.system [echo]', 'no YAML mapping'),
])
def test_broken_and_hostile_files_are_refused(tmp_path, content, message):
    with pytest.raises(MapError, match=message):
        LandmarkMap.from_file(write(tmp_path, content))


def test_a_repeated_landmark_is_refused(tmp_path):
    text = yaml.safe_dump(file_of({'cup_1': CUP, 'cup_2': CUP})).replace('cup_2', 'cup_1')
    with pytest.raises(MapError, match=r"line \d+: 'cup_1' is repeated"):
        LandmarkMap.from_file(write(tmp_path, text))


def test_what_has_no_end_is_not_read(tmp_path):
    pipe = tmp_path / 'pipe'
    os.mkfifo(pipe)
    for path in ('/dev/zero', pipe, tmp_path):
        with pytest.raises(MapError, match=f'{path}: not a regular file'):
            LandmarkMap.from_file(path)


def test_a_file_too_large_is_refused(tmp_path):
    with (tmp_path / 'map.yaml').open('wb') as file:
        file.truncate(parameter_file.MAX_FILE_BYTES + 1)  # holes: it takes no disk
    with pytest.raises(MapError, match='larger than 256 MiB'):
        LandmarkMap.from_file(tmp_path / 'map.yaml')


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(MapError, match=r'nowhere\.yaml: No such file'):
        LandmarkMap.from_file(tmp_path / 'nowhere.yaml')


values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner,
                                                                max_size=3))


@given(st.sampled_from(sorted(CUP)), values)
def test_any_value_of_a_field_gives_a_map_or_a_map_error(field, value):
    landmark = copy.deepcopy(CUP)
    landmark[field] = value
    try:
        loaded = LandmarkMap.from_mapping({'frame_id': 'map', 'landmarks': {'cup_1': landmark}},
                                          'here')
    except MapError:
        return
    assert np.isfinite(loaded.shapes).all()
