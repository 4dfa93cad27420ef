# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A scan and a grid: small exact grids, a corridor, rooms that look alike, invalid input."""

from dataclasses import replace

import numpy as np
import pytest
from scene import level, map_of, rigid

from cliploc_ros.core.fit.scan_match import ScanMatcher
from cliploc_ros.core.geometry.grid import FAR, UNKNOWN, OccupancyGrid
from cliploc_ros.core.geometry.transforms import invert_transform, pose_error
from cliploc_ros.core.observation import Scan
from cliploc_ros.errors import OptionsError

SIDE_M = 0.05
LASER = invert_transform(level()) @ rigid((0.1, 0.0, -0.5))  # of a level camera
MAP = map_of('abcd', np.eye(4)[:, :3])
ANGLES = np.linspace(-np.pi, np.pi, 360, endpoint=False)
WIDE = np.diag([0.1, 0.1, 0.01, 1e-4, 1e-4, 0.05])


def grid_of(walls, width=8.0, depth=6.0, origin=None):
    """Return a grid of free cells with walls: x, y, x, y of opposite corners [m]."""
    cells = np.zeros((round(depth / SIDE_M), round(width / SIDE_M)), np.int8)
    for wall in walls:
        left, low, right, high = np.round(np.array(wall) / SIDE_M).astype(int)
        cells[low:max(high, low + 1), left:max(right, left + 1)] = 100
    return OccupancyGrid(cells, SIDE_M, np.eye(4) if origin is None else origin, 'map')


ROOM = grid_of([(0.0, 0.0, 8.0, 0.05), (0.0, 5.95, 8.0, 6.0), (0.0, 0.0, 0.05, 6.0),
                (7.95, 0.0, 8.0, 6.0), (2.0, 1.0, 3.0, 2.0), (6.0, 3.0, 6.1, 6.0)])
CORRIDOR = grid_of([(0.0, 2.0, 40.0, 2.05), (0.0, 4.0, 40.0, 4.05)], 40.0)


def scan_of(grid, pose, angles=ANGLES, most_m=8.0):
    """Return the scan of a laser of a level camera at a pose, by small steps along each beam."""
    laser = invert_transform(grid.frame_from_grid) @ pose @ LASER
    yaw, ways = np.arctan2(laser[1, 0], laser[0, 0]), np.arange(0.0, most_m, 0.01)
    ends = laser[:2, 3] + ways[:, None, None] * np.stack(
        [np.cos(yaw + angles), np.sin(yaw + angles)], axis=1)
    columns, rows = np.moveaxis(np.floor(ends / SIDE_M).astype(int), 2, 0)
    height, width = grid.cells.shape
    hit = (rows >= 0) & (columns >= 0) & (rows < height) & (columns < width)
    hit[hit] = grid.cells[rows[hit], columns[hit]] >= 65
    return Scan(angles, np.where(hit.any(axis=0), ways[hit.argmax(axis=0)], np.inf), most_m, LASER)


def moved(scan, grid, pose, covariance=WIDE):
    matcher = ScanMatcher(scan, grid, MAP)
    return matcher.moved(pose, covariance, matcher.fits(pose))


def test_distances_of_a_small_grid():
    cells = np.full((3, 20), -1, np.int8)
    cells[1] = [100, *[0] * 12, *[-1] * 7]
    field = OccupancyGrid(cells, SIDE_M, np.eye(4), 'map').field
    assert field.margin_m == pytest.approx(11 * SIDE_M)
    assert field.gaps[12, 11:24].tolist() == [10 * number for number in range(13)]
    assert (field.gaps[12, 24:] == UNKNOWN).all() and (field.gaps[11, 6:17] < UNKNOWN).all()
    assert field.coarse.shape == (7, 11) and field.coarse[3, 2] == 0
    assert len(field.poses) == 2000 and (field.poses[:, 0] >= 15 * SIDE_M).all()
    assert (OccupancyGrid(np.zeros((9, 9), np.int8), 1.0, np.eye(4), 'map').field.gaps[
        2:-2, 2:-2] == FAR).all()


@pytest.mark.parametrize('origin', [np.eye(4), rigid((3.0, -40.0, 0.1), degrees=130.0)])
@pytest.mark.parametrize('angles', [ANGLES, ANGLES[100:-100]])
def test_the_scan_moves_a_pose_in_a_room_to_the_truth(origin, angles):
    grid = replace(ROOM, frame_from_grid=origin)
    truth = origin @ level(4.0, 3.2, 30.0)
    scan = scan_of(grid, truth, angles)
    pose, covariance, fit = moved(scan, grid, origin @ level(4.25, 3.0, 35.0))
    assert pose_error(pose, truth)[0] < 0.08 and pose_error(pose, truth)[1] < 1.0
    assert fit.rank == 1 and fit.explained > 0.95 and 0.25 < fit.moved_m < 0.4
    assert fit.odds > 1.0 and covariance[0, 0] < 0.02 and covariance[2, 2] == pytest.approx(0.01)
    short = np.where(np.arange(len(angles)) % 3, scan.ranges, 0.4 * scan.ranges)
    assert moved(replace(scan, ranges=short), grid, truth)[2].rank == 1, 'people'
    elsewhere = ScanMatcher(scan, grid, MAP).fits(origin @ level(1.0, 4.5, 200.0))
    assert elsewhere.odds < 0.0 and elsewhere.rank > 20


def test_a_corridor_fixes_one_direction():
    truth = level(20.0, 3.0)
    scan = scan_of(CORRIDOR, truth, most_m=6.0)
    pose, covariance, fit = moved(scan, CORRIDOR, level(20.3, 3.2, 4.0))
    assert abs(pose[1, 3] - 3.0) < 0.05 and pose[0, 3] == pytest.approx(20.3, abs=0.02)
    assert covariance[1, 1] < 0.01 and covariance[0, 0] == pytest.approx(0.1, rel=0.1)
    assert fit.rank > 1, 'much of the corridor looks the same'


def test_beams_through_walls_count_against_and_unknown_cells_say_nothing():
    truth = level(4.0, 3.2, 30.0)
    scan = scan_of(ROOM, truth)
    fits = ScanMatcher(scan, ROOM, MAP).fits(truth)
    far = replace(scan, ranges=scan.ranges + 2.0)
    assert ScanMatcher(far, ROOM, MAP).fits(truth).explained < 0.3
    half = ROOM.cells.copy()
    half[:, :90] = -1
    unknown = ScanMatcher(scan, replace(ROOM, cells=half), MAP).fits(truth)
    assert 0.0 < unknown.odds < fits.odds and unknown.explained > 0.9
    nothing = replace(ROOM, cells=np.where(ROOM.cells > 0, 0, ROOM.cells))
    assert ScanMatcher(scan, nothing, MAP).fits(truth).odds <= 0.0


@pytest.mark.parametrize(('ranges', 'frame_id'), [
    (np.full(360, np.nan), 'map'), (np.full(360, -1.0), 'map'), (np.full(360, np.inf), 'map'),
    (np.full(360, 2.0), 'another map')])
def test_a_scan_without_echoes_or_a_grid_of_another_map_says_nothing(ranges, frame_id):
    scan = Scan(ANGLES, ranges, 8.0, LASER)
    assert ScanMatcher(scan, replace(ROOM, frame_id=frame_id), MAP).fits(level(4.0, 3.0)) is None


@pytest.mark.parametrize('wrong', [
    lambda: replace(ROOM, resolution_m=0.0), lambda: replace(ROOM, cells=ROOM.cells[:0]),
    lambda: replace(ROOM, frame_from_grid=np.diag([1.0, -1.0, 1.0, 1.0])),
    lambda: replace(ROOM, frame_from_grid=rigid(axis='x', degrees=180.0)),
    lambda: Scan(ANGLES, ANGLES[1:], 8.0, LASER), lambda: Scan(ANGLES, ANGLES, np.nan, LASER),
    lambda: Scan(ANGLES, ANGLES, 8.0, np.nan * LASER)])
def test_invalid_input_is_named(wrong):
    with pytest.raises(OptionsError, match=r'^(grid|scan): '):
        wrong()
