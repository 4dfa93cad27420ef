# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Alignment with an occupancy grid: the whole map moves, or a picture says why not."""

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from whole_sets import made_map

from cliploc_ros.cli import build_map
from cliploc_ros.core.geometry.transforms import make_transform, pose_error
from cliploc_ros.core.map.grid_file import read_grid
from cliploc_ros.offline.datasets.map_recording import MapRecording, load_recording
from cliploc_ros.offline.mapping.make_map import read_made_map, write_made_map
from cliploc_ros.offline.recording.grid_alignment import align
from cliploc_ros.offline.recording.joining import Placing

# Walls and a cabinet, corner by corner [m]; an oblong hall fits in two ways.
ROOM = np.array([(0, 0), (6, 0), (6, 3), (4, 3), (4, 5), (1.5, 5), (1.5, 4), (0, 4), (0, 0)])
HALL = np.array([(0, 0), (6, 0), (6, 4), (0, 4), (0, 0)])


def make(corners):
    """Return a map with the points of walls and floor, its z up, the camera 1.2 m high."""
    rng, made = np.random.default_rng(0), made_map(1)
    walls = np.concatenate([a + rng.random((int(400 * np.hypot(*(b - a))), 1)) * (b - a)
                            for a, b in pairwise(corners)])
    points = np.concatenate([np.column_stack([walls, rng.uniform(0.0, 1.9, len(walls))]),
                             np.column_stack([rng.uniform(0.0, 3.9, (900, 2)), np.zeros(900)])])
    count, pose = len(points), make_transform(np.eye(3), np.array([2.0, 2.0, 1.2]))
    layer = replace(made.layer, map_from_camera=pose[None], offsets=np.array([0, count]),
                    points=(points - pose[:3, 3]).astype(np.float32), **{
                        name: np.repeat(getattr(made.layer, name)[:1], count, axis=0)
                        for name in ('pixels', 'descriptors', 'words')})
    return replace(made, layer=layer, keyframes=made.keyframes._replace(removed=layer))


def write_grid(folder, corners, resolution_m=0.05, mirrored=False):
    """Write the grid of a robot that drove through a room; return its file."""
    cells = np.full((140, 160), 205, np.uint8)
    line = np.round((corners + 1.0) / 0.05).astype(np.int32)
    cv2.polylines(cv2.fillPoly(cells, [line], 254), [line], isClosed=True, color=0)
    cv2.imwrite(str(folder / 'floor.png'), cells if mirrored else cells[::-1])
    path = folder / 'floor.yaml'
    path.write_text(f'image: floor.png\nresolution: {resolution_m}\norigin: [-1.0, -1.0, 0.0]\n'
                    'negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n')
    return path


@pytest.mark.parametrize(('corners', 'grid', 'reason'), [
    (ROOM, {}, ''), (ROOM, {'mirrored': True}, 'not mirrored'), (HALL, {}, 'at another place'),
    (ROOM, {'resolution_m': 0.06}, 'resolution')])
def test_a_finished_map_moves_or_stays(tmp_path, run_here, corners, grid, reason):
    made, here, there = make(corners), tmp_path / 'phone.yaml', tmp_path / 'office.yaml'
    away = Placing(1.0, Rotation.from_euler('z', 130.0, degrees=True).as_matrix(),
                   np.array([7.0, -3.0, 1.5]))
    (tmp_path / 'seen.npz').touch()
    write_made_map(here, made.moved(away), ['a test'],
                   MapRecording(tmp_path / 'seen.npz').moved(*away))
    ran = run_here(build_map.main, '--update', here, '--out', there, '--align-grid',
                   write_grid(tmp_path, corners, **grid))
    assert (tmp_path / 'office.align.jpg').exists()
    if reason:
        assert ran.returncode == 1 and reason in ran.stderr and not there.exists()
        return
    found = read_made_map(there)
    np.testing.assert_allclose(found.landmark_map.centers, made.landmark_map.centers, atol=0.05)
    turns = (Rotation.from_quat(found.landmark_map.quats_xyzw).inv()
             * Rotation.from_quat(made.landmark_map.quats_xyzw))
    assert turns.magnitude().max() < 0.01
    for layer in (found.layer, found.keyframes.removed):
        metres, degrees = pose_error(layer.map_from_camera[0], made.layer.map_from_camera[0])
        assert metres < 0.05 and degrees < 0.5
    np.testing.assert_allclose(load_recording(there).placing_of_poses[2], 0.0, atol=0.05)


def test_an_unknown_unit_is_found(tmp_path):
    made, grid = make(ROOM), read_grid(write_grid(tmp_path, ROOM))
    small = made.moved(Placing(0.4, np.eye(3), np.array([0.0, 0.0, 2.0])))
    placing, *_ = align(small.layer, None, grid, is_scaled=True, of_robot=False)
    assert placing.scale == pytest.approx(2.5, rel=0.01)
    np.testing.assert_allclose(placing.shift, [0.0, 0.0, -5.0], atol=0.08)
