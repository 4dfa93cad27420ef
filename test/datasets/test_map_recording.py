# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a map was built from: written beside it, found again, and moved with it."""

import numpy as np
import pytest
from scene import CAMERA
from scipy.spatial.transform import Rotation

from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.map_recording import (
    MapRecording,
    load_recording,
    recording_path,
    save_recording,
)
from cliploc_ros.offline.datasets.observations import save_observations
from cliploc_ros.offline.mapping.posed_detections import PosedDetections


@pytest.fixture
def built(tmp_path):
    """Return a map file, whose observations are scaled and turned, and their poses."""
    folder = tmp_path / 'here'
    (folder / 'drive').mkdir(parents=True)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, 3] = 1.0, 2.0, 3.0
    save_observations(folder / 'drive.npz', PosedDetections(
        (CAMERA,), poses, np.array([0.0, 1.0]), np.array([0, 1, 1]),
        np.array([[1.0, 2.0, 30.0, 40.0]]), ('cup',), np.zeros(1, dtype=np.int64), np.ones(1)))
    turn = Rotation.from_euler('x', 90, degrees=True).as_matrix()
    save_recording(folder / 'm.yaml', MapRecording(
        folder / 'drive.npz', folder / 'drive', '/image', '/info', scale=2.0,
        rotation=turn.tolist()))
    return folder / 'm.yaml', poses


def test_a_moved_folder_keeps_its_recording(built, tmp_path):
    path, poses = built
    path.parent.rename(tmp_path / 'there')
    found = load_recording(tmp_path / 'there/m.yaml')
    assert found.source.samefile(tmp_path / 'there/drive')
    assert (found.image, found.camera_info, found.intrinsics) == ('/image', '/info', None)
    np.testing.assert_allclose(found.load().map_from_camera[:, 1, 3], -2.0 * poses[:, 2, 3])


def test_what_is_gone_is_none_and_what_is_damaged_is_named(built):
    path, _ = built
    (path.parent / 'drive').rmdir()
    assert load_recording(path).source is None
    (path.parent / 'drive.npz').unlink()
    assert load_recording(path) is None
    for text in ('{', '{"speed": 1}', '{"observations": "m.yaml", "scale": -1}',
                 '{"observations": "m.yaml", "scale": Infinity}', '[]', 9_999 * '[',
                 '{"observations": "m.yaml", "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}'):
        recording_path(path).write_text(text)
        with pytest.raises(DatasetError, match='recording'):
            load_recording(path)
    assert load_recording(path.with_name('other.yaml')) is None
