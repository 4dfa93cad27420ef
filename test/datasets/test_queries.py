# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Query files: reading, refusing and writing them."""

import subprocess
import sys
import textwrap
from dataclasses import replace

import numpy as np
import pytest

from cliploc_ros.datasets.queries import load_queries, save_queries
from cliploc_ros.errors import DatasetError


def make_arrays() -> dict[str, np.ndarray]:
    """Two groups, three frames, the second of them without a box; three landmarks."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, :3, 3] = [1, 2, 3]
    return {
        'landmark_ids': np.array(['cup_1', 'cup_2', 'tv_1']),
        'intrinsics_fx_fy_cx_cy': np.array([500.0, 501, 320, 240]),
        'frame_offsets': np.array([0, 2, 2, 3]),
        'boxes_xyxy': np.array([[0.0, 0, 10, 10], [5, 6, 7, 8], [1, 2, 30, 40]]),
        'class_ids': np.array(['cup', 'tv', 'cup']),
        'scores': np.array([0.5, 0.75, 1.0]),
        'similarities': np.arange(9, dtype=np.float32).reshape(3, 3) / 10,
        'true_landmark': np.array([0, 2, -1]),
        'map_from_camera': poses,
        'timestamps': np.array([1341847980.722988, 1341847980.754743, 1341847981.0]),
        'query_group': np.array([0, 0, 4]),
        'is_main': np.array([True, False, True]),
    }


def save(path, arrays):
    np.savez_compressed(path, **arrays)
    return path


def test_frames(tmp_path):
    path = save(tmp_path / 'q.npz', make_arrays())
    queries = load_queries(path, ['cup_1', 'cup_2', 'tv_1', 'lamp'])
    assert queries.landmark_ids == ('cup_1', 'cup_2', 'tv_1')
    assert queries.intrinsics_fx_fy_cx_cy == (500, 501, 320, 240)
    assert [len(frame) for frame in queries] == [2, 0, 1]
    assert [frame.stamp_ns for frame in queries] == [
        1341847980722988000, 1341847980754743000, 1341847981000000000
    ]
    first, second, third = queries
    assert first.class_ids == ('cup', 'tv')
    np.testing.assert_array_equal(first.bboxes_xyxy, [[0, 0, 10, 10], [5, 6, 7, 8]])
    np.testing.assert_array_equal(first.true_landmark, [0, 2])
    assert first.similarities.shape == (2, 3)
    assert second.bboxes_xyxy.shape == (0, 4)
    assert second.similarities.shape == (0, 3)
    np.testing.assert_array_equal(second.map_from_camera[:3, 3], [1, 2, 3])
    np.testing.assert_allclose(third.similarities, [[0.6, 0.7, 0.8]])
    assert queries.main_frames() == (first, third)
    assert queries.group(0) == (first, second)


def put(name, index, value):
    def change(arrays):
        if isinstance(value, float):
            arrays[name] = arrays[name].astype(np.float64)
        arrays[name][index] = value

    return change


def become(name, value):
    return lambda arrays: arrays.update({name: np.asarray(value)})


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (lambda arrays: arrays.pop('scores'), 'array scores is missing'),
        (become('scores', [0.5, 0.5]), r'array scores has shape \(2,\), expected \(3,\)'),
        (become('similarities', np.zeros((3, 2))), r'similarities has shape \(3, 2\), .*\(3, 3\)'),
        (become('boxes_xyxy', np.zeros((3, 5))), r'boxes_xyxy has shape \(3, 5\), .*\(3, 4\)'),
        (become('boxes_xyxy', 3.0), 'array boxes_xyxy is a single value'),
        (become('map_from_camera', np.zeros((3, 3, 4))), r'map_from_camera has shape'),
        (become('class_ids', [1, 2, 3]), 'array class_ids has type int64, expected text'),
        (become('true_landmark', [0.0, 1, 2]), 'true_landmark has type float64, .*integers'),
        (become('is_main', [1, 0, 1]), 'is_main has type int64, expected booleans'),
        (put('boxes_xyxy', (1, 2), np.nan), 'array boxes_xyxy is not finite in row 1'),
        (put('boxes_xyxy', (2, 2), 1.0), 'boxes_xyxy is not left, top, right, bottom in row 2'),
        (put('similarities', (0, 0), np.inf), 'array similarities is not finite in row 0'),
        (put('similarities', (1, 1), 30.0), 'similarities is no cosine, .* in row 1'),
        (put('scores', 2, -0.1), 'scores is outside 0 to 1 in row 2'),
        (put('true_landmark', 0, 3), 'true_landmark is no landmark in row 0'),
        (put('map_from_camera', (1, 0, 0), 2.0), 'map_from_camera is no rigid transform in row 1'),
        (put('map_from_camera', (2, 3, 0), 1.0), 'map_from_camera is no rigid transform in row 2'),
        (put('map_from_camera', (0, 2, 2), -1.0), 'map_from_camera is no rigid transform in row'),
        (put('timestamps', 0, -1.0), 'timestamps is negative in row 0'),
        (put('frame_offsets', 1, 3), 'frame_offsets decreases in row 2'),
        (put('frame_offsets', 3, 2), 'frame_offsets goes from 0 to 2, expected 0 to 3'),
        (put('landmark_ids', 0, 'cup_2'), 'landmark_ids repeats an id in row 1'),
        (put('landmark_ids', 0, ''), 'landmark_ids is empty in row 0'),
        (put('intrinsics_fx_fy_cx_cy', 0, 0.0), 'focal length'),
        (put('is_main', 1, True), 'is_main marks 2 frames of query_group 0'),
        (put('is_main', 2, False), 'is_main marks 0 frames of query_group 4'),
        (become('stamps_ns', np.zeros(3, dtype=np.int64)), 'stamps_ns contradicts timestamps'),
        (become('scores', np.array([1, 'a', None], dtype=object)), 'array scores cannot be read'),
    ],
)
def test_malformed_arrays_are_named(tmp_path, change, message):
    arrays = make_arrays()
    change(arrays)
    path = save(tmp_path / 'q.npz', arrays)
    with pytest.raises(DatasetError, match=message) as caught:
        load_queries(path)
    assert str(path) in str(caught.value)


def test_empty_files_are_refused(tmp_path):
    arrays = make_arrays()
    for name, rows in (('frame_offsets', 1), *((name, 0) for name in (
        'boxes_xyxy', 'class_ids', 'scores', 'similarities', 'true_landmark', 'map_from_camera',
        'timestamps', 'query_group', 'is_main',
    ))):
        arrays[name] = arrays[name][:rows]
    with pytest.raises(DatasetError, match='holds no frames'):
        load_queries(save(tmp_path / 'q.npz', arrays))


def test_landmarks_unknown_to_the_map_are_named(tmp_path):
    path = save(tmp_path / 'q.npz', make_arrays())
    with pytest.raises(DatasetError, match=r"'cup_2', which the map does not know \(and 1 more"):
        load_queries(path, ['cup_1'])


@pytest.mark.parametrize(
    'damage',
    [
        lambda data: b'',
        lambda data: b'hello',
        lambda data: data[:100],
        lambda data: data[:-30],
        lambda data: data[:600] + b'\xff' * 100 + data[700:],
    ],
)
def test_broken_files_are_refused(tmp_path, damage):
    path = save(tmp_path / 'q.npz', make_arrays())
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(DatasetError, match=r'q\.npz'):
        load_queries(path)


def test_other_files_are_refused(tmp_path):
    with pytest.raises(DatasetError, match='no such query file'):
        load_queries(tmp_path / 'none.npz')
    np.save(tmp_path / 'single.npy', np.zeros(3))
    with pytest.raises(DatasetError, match='a single array'):
        load_queries(tmp_path / 'single.npy')


def test_byte_strings_are_read(tmp_path):
    arrays = make_arrays()
    arrays['class_ids'] = arrays['class_ids'].astype('S')
    assert load_queries(save(tmp_path / 'q.npz', arrays))[0].class_ids == ('cup', 'tv')


def assert_same(queries, others):
    assert queries.landmark_ids == others.landmark_ids
    assert queries.intrinsics_fx_fy_cx_cy == others.intrinsics_fx_fy_cx_cy
    assert len(queries) == len(others)
    for one, other in zip(queries, others, strict=True):
        for name, value in vars(one).items():
            np.testing.assert_array_equal(value, getattr(other, name), err_msg=name)


def test_round_trip(tmp_path):
    queries = load_queries(save(tmp_path / 'q.npz', make_arrays()))
    # A float64 of seconds cannot hold this stamp.
    exact = replace(queries[2], stamp_ns=1341847981000000123)
    queries = replace(queries, frames=(*queries.frames[:2], exact))
    save_queries(tmp_path / 'again.npz', queries)
    assert_same(load_queries(tmp_path / 'again.npz'), queries)


def test_real_file_round_trip(shared_data, tmp_path):
    path = shared_data / 'tum_fr3_office' / 'queries.npz'
    queries = load_queries(path)
    assert (len(queries), len(queries.main_frames()), len(queries.landmark_ids)) == (258, 52, 40)
    save_queries(tmp_path / 'again.npz', queries)
    assert_same(load_queries(tmp_path / 'again.npz'), queries)
    original, again = np.load(path), np.load(tmp_path / 'again.npz')
    for name in original.files:
        np.testing.assert_array_equal(original[name], again[name], err_msg=name)
        assert original[name].dtype == again[name].dtype


def test_equal_queries_make_equal_files(tmp_path):
    queries = load_queries(save(tmp_path / 'q.npz', make_arrays()))
    save_queries(tmp_path / 'a.npz', queries)
    save_queries(tmp_path / 'b.npz', queries)
    assert (tmp_path / 'a.npz').read_bytes() == (tmp_path / 'b.npz').read_bytes()


def test_malformed_queries_are_not_written(tmp_path):
    queries = load_queries(save(tmp_path / 'q.npz', make_arrays()))
    wrong = replace(queries[0], bboxes_xyxy=np.full((2, 4), np.nan))
    with pytest.raises(DatasetError, match='boxes_xyxy is not finite'):
        save_queries(tmp_path / 'again.npz', replace(queries, frames=(wrong, *queries.frames[1:])))
    ragged = replace(queries[0], similarities=np.zeros((2, 7)))
    with pytest.raises(DatasetError, match='cannot be written'):
        save_queries(tmp_path / 'again.npz', replace(queries, frames=(ragged,)))
    assert [path.name for path in tmp_path.iterdir()] == ['q.npz']


def test_full_disk_keeps_the_old_file(tmp_path):
    """A limit on the size of files gives the error of a full disk."""
    path = save(tmp_path / 'q.npz', make_arrays())
    before = path.read_bytes()
    program = textwrap.dedent("""
        import resource, sys
        from cliploc_ros.datasets.queries import load_queries, save_queries
        from cliploc_ros.errors import DatasetError
        queries = load_queries(sys.argv[1])
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
        try:
            save_queries(sys.argv[1], queries)
        except DatasetError as error:
            print(error)
    """)
    run = subprocess.run(
        [sys.executable, '-c', program, path],
        capture_output=True, text=True, check=True, timeout=300,
    )
    assert 'cannot be written: File too large; nothing was changed' in run.stdout
    assert [one.name for one in tmp_path.iterdir()] == ['q.npz']
    assert path.read_bytes() == before


def test_missing_folder_is_named(tmp_path):
    queries = load_queries(save(tmp_path / 'q.npz', make_arrays()))
    with pytest.raises(DatasetError, match=r'nowhere/q\.npz: cannot be written: No such file'):
        save_queries(tmp_path / 'nowhere' / 'q.npz', queries)
