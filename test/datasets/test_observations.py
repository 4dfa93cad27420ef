# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Observation files: reading, refusing and writing them."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cliploc_ros.datasets.observations import load_observations, save_observations
from cliploc_ros.errors import DatasetError


def make_arrays() -> dict[str, np.ndarray]:
    """Three frames, the second of them without a box."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, :3, 3] = [1, 2, 3]
    return {
        'intrinsics_fx_fy_cx_cy': np.array([500.0, 501, 320, 240]),
        'image_size': np.array([640, 480]),
        'frame_offsets': np.array([0, 2, 2, 3]),
        'boxes_xyxy': np.array([[0.0, 0, 10, 10], [5, 6, 7, 8], [1, 2, 30, 40]]),
        'class_ids': np.array(['cup', 'tv', 'cup']),
        'scores': np.array([0.5, 0.75, 1.0]),
        'map_from_camera': poses,
        'timestamps': np.array([10.0, 10.5, 11.0]),
    }


def save(path, arrays):
    np.savez_compressed(path, **arrays)
    return path


def test_reads_every_array(tmp_path):
    loaded = load_observations(save(tmp_path / 'o.npz', make_arrays()))
    assert (loaded.camera.width, loaded.camera.height, loaded.camera.fy) == (640, 480, 501.0)
    assert loaded.class_names == ('cup', 'tv')
    assert loaded.classes.tolist() == [0, 1, 0]
    assert loaded.frames.tolist() == [0, 0, 2]
    assert loaded.bboxes_xyxy[2].tolist() == [1, 2, 30, 40]
    assert loaded.map_from_camera[1, :3, 3].tolist() == [1, 2, 3]
    assert loaded.stamps_s.tolist() == [10.0, 10.5, 11.0]


def test_puts_frames_in_the_order_of_time(tmp_path):
    arrays = make_arrays() | {'timestamps': np.array([11.0, 10.5, 10.0])}
    loaded = load_observations(save(tmp_path / 'o.npz', arrays))
    assert loaded.stamps_s.tolist() == [10.0, 10.5, 11.0]
    assert loaded.frame_offsets.tolist() == [0, 1, 1, 3]
    assert loaded.classes.tolist() == [0, 0, 1]


def test_a_written_file_is_read_back(tmp_path):
    first = load_observations(save(tmp_path / 'o.npz', make_arrays()))
    save_observations(tmp_path / 'again.npz', first)
    again = load_observations(tmp_path / 'again.npz')
    for name in ('map_from_camera', 'stamps_s', 'frame_offsets', 'bboxes_xyxy', 'classes',
                 'scores'):
        assert (getattr(again, name) == getattr(first, name)).all()
    assert (again.camera, again.class_names) == (first.camera, first.class_names)


def test_odometry_is_read_back_in_the_order_of_time(tmp_path):
    odometry = np.tile(np.eye(4), (3, 1, 1))
    odometry[:, 0, 3] = [3.0, np.nan, 1.0]
    odometry[1] = np.nan
    arrays = make_arrays() | {'timestamps': np.array([11.0, 10.5, 10.0]),
                              'odom_from_camera': odometry}
    loaded = load_observations(save(tmp_path / 'o.npz', arrays))
    assert loaded.odom_from_camera[[0, 2], 0, 3].tolist() == [1.0, 3.0]
    assert np.isnan(loaded.odom_from_camera[1]).all()
    save_observations(tmp_path / 'again.npz', loaded)
    np.testing.assert_array_equal(load_observations(tmp_path / 'again.npz').odom_from_camera,
                                  loaded.odom_from_camera)


def test_embeddings_stay_in_the_file(tmp_path):
    rows = np.random.default_rng(0).normal(size=(3, 300_000)).astype(np.float16)
    given = replace(load_observations(save(tmp_path / 'o.npz', make_arrays())), embeddings=rows)
    save_observations(tmp_path / 'large.npz', given)
    loaded = load_observations(tmp_path / 'large.npz')
    assert isinstance(loaded.embeddings, np.memmap)
    assert (loaded.embeddings == rows).all()
    save(tmp_path / 'compressed.npz', make_arrays() | {'embeddings': rows})
    assert (load_observations(tmp_path / 'compressed.npz').embeddings == rows).all()

    content = bytearray((tmp_path / 'large.npz').read_bytes())
    content[content.index(rows[1].tobytes()[:50]) + 20] ^= 1  # as a failing disk does
    (tmp_path / 'large.npz').write_bytes(content)
    with pytest.raises(DatasetError, match='array embeddings cannot be read: Bad CRC-32'):
        load_observations(tmp_path / 'large.npz')


def test_reads_the_shared_file(shared_data):
    loaded = load_observations(shared_data / 'tum_fr3_office' / 'observations.npz')
    assert len(loaded) == 2583
    assert len(loaded.classes) == 17211


def put(name, index, value):
    def change(arrays):
        arrays[name] = arrays[name].astype(np.float64)
        arrays[name][index] = value
    return change


def become(name, value):
    return lambda arrays: arrays.update({name: np.asarray(value)})


@pytest.mark.parametrize(('change', 'message'), [
    (lambda arrays: arrays.pop('scores'), 'array scores is missing'),
    (lambda arrays: (arrays.pop('image_size'), arrays.update(similarities=np.eye(3))),
     'array image_size is missing .this is a query file'),
    (become('timestamps', 3.0), 'array timestamps is a single value'),
    (become('scores', [0.5, 0.5]), 'array scores has shape .2,., expected .3,.'),
    (become('frame_offsets', [0.0, 2, 2, 3]), 'frame_offsets has type float64, expected integers'),
    (become('class_ids', [1, 2, 3]), 'class_ids has type int64, expected text'),
    (become('frame_offsets', [0, 2, 2, 4]), 'goes from 0 to 4, expected 0 to 3, the number'),
    (become('frame_offsets', [0, 2, 1, 3]), 'frame_offsets decreases in row 2'),
    (put('boxes_xyxy', (1, 0), np.nan), 'array boxes_xyxy is not finite in row 1'),
    (put('boxes_xyxy', (1, 0), 9.0), 'boxes_xyxy is not left, top, right, bottom in row 1'),
    (put('scores', 2, 1.5), 'scores is outside 0 to 1 in row 2'),
    (put('map_from_camera', (2, 0, 0), 2.0), 'map_from_camera is no rigid transform in row 2'),
    (become('odom_from_camera', np.zeros((2, 4, 4))), 'shape .2, 4, 4., expected .3, 4, 4.'),
    (become('odom_from_camera', [np.eye(4), np.eye(4), np.diag([1.0, 1, -1, 1])]),
     'odom_from_camera is no rigid transform in row 2'),
    (become('odom_from_camera', [np.eye(4), np.diag([np.nan, 1, 1, 1]), np.eye(4)]),
     'odom_from_camera is no rigid transform in row 1'),
    (become('odom_from_camera', [np.eye(4), np.diag([1.0, 1, 1, np.inf]), np.eye(4)]),
     'odom_from_camera is no rigid transform in row 1'),
    (put('intrinsics_fx_fy_cx_cy', 0, 0.0), 'focal lengths must be positive'),
    (become('image_size', [0, 480]), 'image size 0x480'),
])
def test_refuses_what_is_malformed(tmp_path, change, message):
    arrays = make_arrays()
    change(arrays)
    path = save(tmp_path / 'o.npz', arrays)
    with pytest.raises(DatasetError, match=message) as caught:
        load_observations(path)
    assert str(path) in str(caught.value)


def test_refuses_files_that_are_something_else(tmp_path):
    with pytest.raises(DatasetError, match='no such observation file'):
        load_observations(tmp_path / 'missing.npz')
    (tmp_path / 'text.npz').write_text('boxes')
    with pytest.raises(DatasetError, match='no complete npz file'):
        load_observations(tmp_path / 'text.npz')
    whole = save(tmp_path / 'o.npz', make_arrays()).read_bytes()
    for size in (0, 10, len(whole) // 2, len(whole) - 1):
        (tmp_path / 'cut.npz').write_bytes(whole[:size])
        with pytest.raises(DatasetError, match='record the observations again'):
            load_observations(tmp_path / 'cut.npz')
    np.save(tmp_path / 'single.npy', np.eye(3))
    (tmp_path / 'single.npy').rename(tmp_path / 'single.npz')
    with pytest.raises(DatasetError, match='is a single array'):
        load_observations(tmp_path / 'single.npz')


def test_the_old_file_stays_when_the_new_one_cannot_be_written(tmp_path):
    path = save(tmp_path / 'o.npz', make_arrays())
    good = load_observations(path)
    old = path.read_bytes()
    with pytest.raises(DatasetError, match='cannot be written: array scores is outside'):
        save_observations(path, replace(good, scores=np.array([2.0, 0.5, 0.5])))
    assert path.read_bytes() == old
    assert [file.name for file in tmp_path.iterdir()] == ['o.npz']
    with pytest.raises(DatasetError, match='cannot be written: No such file'):
        save_observations(tmp_path / 'missing' / 'o.npz', good)


@pytest.mark.skipif(not Path('/dev/full').exists(), reason='needs /dev/full')
def test_a_full_disk_is_named(tmp_path):
    good = load_observations(save(tmp_path / 'o.npz', make_arrays()))
    path = tmp_path / 'full.npz'
    # the temporary file of this process, on a disk without room
    (tmp_path / f'.{os.getpid()}.full.npz').symlink_to('/dev/full')
    with pytest.raises(DatasetError, match='No space left on device; nothing was changed'):
        save_observations(path, good)
    assert not path.exists()
