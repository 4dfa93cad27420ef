# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Query files, observation files and records of a map's origin: read, refused and written."""

import pickle
from dataclasses import asdict, replace

import numpy as np
import pytest
from scene import CAMERA
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.errors import DatasetError, MapError
from cliploc_ros.files.arrays import FINITE, Field, Schema, StoredArray
from cliploc_ros.offline.datasets import map_recording, observations
from cliploc_ros.offline.datasets.folders import read_folder
from cliploc_ros.offline.datasets.images import images_of_recording
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.units import NS_PER_S
from demo import ASSETS


def frame_arrays() -> dict[str, np.ndarray]:
    """Return three frames, the second without boxes."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, :3, 3] = [1, 2, 3]
    return {
        'intrinsics_fx_fy_cx_cy': np.array([500.0, 501, 320, 240]),
        'frame_offsets': np.array([0, 2, 2, 3]),
        'boxes_xyxy': np.array([[0.0, 0, 10, 10], [5, 6, 7, 8], [1, 2, 30, 40]]),
        'class_ids': np.array(['cup', 'tv', 'cup']),
        'scores': np.array([0.5, 0.75, 1.0]),
        'map_from_camera': poses,
        'timestamps': np.array([1341847980.722988, 1341847980.754743, 1341847981.0]),
    }


def query_arrays() -> dict[str, np.ndarray]:
    """Return observations of two groups and three landmarks."""
    return frame_arrays() | {
        'landmark_ids': np.array(['cup_1', 'cup_2', 'tv_1']),
        'similarities': np.arange(9, dtype=np.float32).reshape(3, 3) / 10,
        'true_landmark': np.array([0, 2, -1]),
        'query_group': np.array([0, 0, 4]),
        'is_main': np.array([True, False, True]),
    }


def observation_arrays() -> dict[str, np.ndarray]:
    return frame_arrays() | {'image_size': np.array([640, 480]),
                             'timestamps': np.array([10.0, 10.5, 11.0])}


def save(path, arrays):
    np.savez_compressed(path, **arrays)
    return path


def put(name, index, value):
    def change(arrays):
        if isinstance(value, float):
            arrays[name] = arrays[name].astype(np.float64)
        arrays[name][index] = value
    return change


def become(name, value):
    return lambda arrays: arrays.update({name: np.asarray(value)})


# ---- both ---------------------------------------------------------------------------------------
@pytest.mark.parametrize(('change', 'message'), [
    (lambda arrays: arrays.pop('scores'), 'scores is missing'),
    (become('scores', [0.5, 0.5]), 'scores has shape'),
    (become('class_ids', [1, 2, 3]), 'class_ids has type'),
    (become('frame_offsets', [0, 2, 2, 4]), 'ranges from 0 to 4'),
    (put('boxes_xyxy', (1, 2), np.nan), 'finite in row 1'),
    (put('boxes_xyxy', (2, 2), 1.0), 'boxes_xyxy.* row 2'),
    (put('scores', 2, 1.5), 'scores.* in row 2'),
    (put('map_from_camera', (2, 3, 0), 1.0), 'rigid.* in row 2'),
    (put('boxes_xyxy', (1, 2), 1e308), r'beyond 1e\+10.* row 1'),
    (become('depths', [1.0, np.inf, np.nan]), 'depths is not positive and finite in row 1'),
    (become('stamps_ns', [0, 1, 2]), 'stamps_ns contradicts timestamps in row 0'),
    (become('scores', np.array([1, 'a', None], dtype=object)), 'scores cannot be')])
def test_malformed_arrays_are_named(tmp_path, change, message):
    path, queries, seen = tmp_path / 'q.npz', query_arrays(), observation_arrays()
    for arrays, load in ((queries, observations.load_queries),
                         (seen, observations.load_observations)):
        change(arrays)
        with pytest.raises(DatasetError, match=message) as caught:
            load(save(path, arrays))
        assert str(path) in str(caught.value)


# ---- queries ------------------------------------------------------------------------------------
def test_queries_are_read(tmp_path):
    path = save(tmp_path / 'q.npz', query_arrays())
    queries = observations.load_queries(path)
    assert queries.landmark_ids == ('cup_1', 'cup_2', 'tv_1')
    first, second, third = queries.frames
    seen = [frame.observation for frame in queries.frames]
    assert {one.camera for one in seen} == {Camera(640, 480, 500, 501, 320, 240)}
    assert [one.stamp_ns for one in seen] == [
        1341847980722988000, 1341847980754743000, 1341847981000000000]
    assert [one.detections.class_ids for one in seen] == [('cup', 'tv'), (), ('cup',)]
    np.testing.assert_array_equal(seen[0].detections.bboxes_xyxy, [[0, 0, 10, 10], [5, 6, 7, 8]])
    np.testing.assert_array_equal(first.true_landmark, [0, 2])
    assert [one.similarities.shape for one in seen] == [(2, 3), (0, 3), (1, 3)]
    np.testing.assert_array_equal(second.map_from_camera[:3, 3], [1, 2, 3])
    np.testing.assert_allclose(seen[2].similarities, [[0.6, 0.7, 0.8]])
    assert [frame.is_main for frame in queries.frames] == [True, False, True]
    assert first.group == second.group != third.group


def test_queries_come_back(tmp_path):
    queries = observations.load_queries(save(tmp_path / 'q.npz', query_arrays()))
    # A float64 of seconds cannot hold this stamp.
    frames = [replace(frame, observation=replace(
        frame.observation, stamp_ns=stamp_ns, camera=Camera(600, 480, 500, 501, 320, 240)))
        for frame, stamp_ns in zip(queries.frames, (1, 2, 1341847981000000123), strict=True)]
    queries = replace(queries, frames=tuple(frames))
    observations.save_queries(tmp_path / 'again.npz', queries)
    again = observations.load_queries(tmp_path / 'again.npz')
    assert again.landmark_ids == queries.landmark_ids
    for query, other in zip(queries.frames, again.frames, strict=True):
        np.testing.assert_equal(asdict(query), asdict(other))
    observations.save_queries(tmp_path / 'other.npz', queries)
    assert (tmp_path / 'other.npz').read_bytes() == (tmp_path / 'again.npz').read_bytes()


# ---- observations -------------------------------------------------------------------------------
def test_odometry_is_read_back_in_the_order_of_time(tmp_path):
    odometry = np.tile(np.eye(4), (3, 1, 1))
    odometry[:, 0, 3] = [3.0, np.nan, 1.0]
    odometry[1] = np.nan
    arrays = observation_arrays() | {'timestamps': np.array([11.0, 10.5, 10.0]),
                              'odom_from_camera': odometry}
    loaded = observations.load_observations(save(tmp_path / 'o.npz', arrays))
    assert loaded.odom_from_camera[[0, 2], 0, 3].tolist() == [1.0, 3.0]
    assert np.isnan(loaded.odom_from_camera[1]).all()
    observations.save_observations(tmp_path / 'again.npz', loaded)
    again = observations.load_observations(tmp_path / 'again.npz')
    np.testing.assert_array_equal(again.odom_from_camera, loaded.odom_from_camera)


def test_embeddings_come_back(tmp_path):
    rows = np.random.default_rng(0).normal(size=(3, 300_000)).astype(np.float16)
    plain = observations.load_observations(save(tmp_path / 'o.npz', observation_arrays()))
    given = replace(plain, embeddings=rows)
    observations.save_observations(tmp_path / 'large.npz', given)
    assert (observations.load_observations(tmp_path / 'large.npz').embeddings == rows).all()
    save(tmp_path / 'compressed.npz', observation_arrays() | {'embeddings': rows})
    assert (observations.load_observations(tmp_path / 'compressed.npz').embeddings == rows).all()


@pytest.fixture
def built(tmp_path):
    """Return a map file with scaled and turned observations, and their poses."""
    folder = tmp_path / 'here'
    (folder / 'drive').mkdir(parents=True)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, 3] = 1.0, 2.0, 3.0
    observations.save_observations(folder / 'drive.npz', PosedDetections(
        (CAMERA,), poses, np.array([0.0, 1.0]), np.array([0, 1, 1]),
        np.array([[1.0, 2.0, 30.0, 40.0]]), ('cup',), np.zeros(1, dtype=np.int64), np.ones(1)))
    turn = Rotation.from_euler('x', 90, degrees=True).as_matrix()
    map_recording.save_recording(folder / 'm.yaml', map_recording.MapRecording(
        folder / 'drive.npz', folder / 'drive', '/image', '/info', scale=2.0,
        rotation=turn.tolist()))
    return folder / 'm.yaml', poses


def test_a_moved_folder_keeps_its_recording(built, tmp_path):
    path, poses = built
    path.parent.rename(tmp_path / 'there')
    found = map_recording.load_recording(tmp_path / 'there/m.yaml')
    assert found.source.samefile(tmp_path / 'there/drive')
    assert (found.image, found.camera_info, found.intrinsics) == ('/image', '/info', None)
    np.testing.assert_allclose(found.load().map_from_camera[:, 1, 3], -2.0 * poses[:, 2, 3])


def test_a_large_array_stays_in_its_file_which_may_be_replaced_but_not_overwritten(tmp_path):
    """A mapped file would end the process with SIGBUS."""
    values, path = np.random.default_rng(0).random((2_000_000, 3), np.float32), tmp_path / 'a.npz'
    schema = Schema('file', {'a': Field('floats', ('n', 3), (FINITE,), is_stored=True)}, MapError)
    schema.write(path, {'a': values})
    first = schema.read(path)['a']
    assert isinstance(first, StoredArray) and len(first) == len(values)
    schema.write(path, {'a': values[::-1]})  # in another file, which takes its place
    second, rows = schema.read(path)['a'], np.array([7, 3, 1_999_999])
    for found, truth in ((first, values), (second, values[::-1])):
        np.testing.assert_array_equal(found[5:9], truth[5:9])
        np.testing.assert_array_equal(found[rows], truth[rows])
        np.testing.assert_array_equal(np.asarray(found, np.float64), truth)
    assert first[rows[:0]].shape == (0, 3)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(first)), values)
    path.write_bytes(b'cut')
    with pytest.raises(MapError, match='overwritten while it is used'):
        second[1:3]
    np.testing.assert_array_equal(first[5:9], values[5:9])


def test_the_images_of_all_recordings_of_a_map_are_found(built, tmp_path):
    """The second one has another camera; stamps of recordings that overlap are moved."""
    path, _ = built
    first, second = (map_recording.MapRecording(
        path.with_name('drive.npz'), ASSETS / name, cameras=('',)) for name in (
            'mapping', 'sequence'))
    map_recording.save_recording(path, replace(first, others=(replace(second, later_s=3600.0),)))
    images = images_of_recording(map_recording.load_recording(path), ['', '#1'])
    for name, camera, later_s in (('mapping', '', 0.0), ('sequence', '#1', 3600.0)):
        seen = next(read_folder(ASSETS / name).read())
        found = images.near(seen.stamp_ns / NS_PER_S + later_s, camera)
        np.testing.assert_array_equal(found, seen.image_rgb)


def test_what_is_gone_is_none_and_what_is_damaged_is_named(built):
    path, _ = built
    (path.parent / 'drive').rmdir()
    assert map_recording.load_recording(path).source is None
    (path.parent / 'drive.npz').unlink()
    assert map_recording.load_recording(path) is None
    for text in ('{"speed": 1}', '{"observations": "m.yaml", "scale": -1}', '[]',
                 '{"observations": "m.yaml", "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}'):
        map_recording.recording_path(path).write_text(text)
        with pytest.raises(DatasetError, match='recording'):
            map_recording.load_recording(path)
    assert map_recording.load_recording(path.with_name('other.yaml')) is None
