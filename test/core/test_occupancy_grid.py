# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Occupancy grids: cells, ways, and the files of nav2_map_server, sound and damaged."""

import math

import cv2
import numpy as np
import pytest

from cliploc_ros.core.map.occupancy_grid import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    read_occupancy_grid,
)
from cliploc_ros.errors import MapError

# row 0 is at the origin: y up
CELLS = np.array([[FREE, OCCUPIED, FREE], [UNKNOWN, FREE, FREE]], dtype=np.int8)
YAML = """image: walls.{suffix}
mode: trinary
resolution: 0.5
origin: [1.0, -2.0, {yaw}]
negate: {negate}
occupied_thresh: 0.65
free_thresh: 0.196
"""


def write(folder, suffix='pgm', negate=0, yaw=0.0, text=YAML):
    """Write CELLS as nav2's map_saver does."""
    image = np.choose(CELLS[::-1] + 1, [205, 254, 0]).astype(np.uint8)
    cv2.imwrite(str(folder / f'walls.{suffix}'), 255 - image if negate else image)
    (folder / 'walls.yaml').write_text(text.format(suffix=suffix, negate=negate, yaw=yaw))
    return folder / 'walls.yaml'


@pytest.mark.parametrize('suffix', ['pgm', 'png'])
def test_a_file_of_map_server_is_read(tmp_path, suffix):
    grid = read_occupancy_grid(write(tmp_path, suffix), 'map')
    np.testing.assert_array_equal(grid.cells, CELLS)
    assert (grid.frame_id, grid.resolution_m, grid.origin) == ('map', 0.5, (1.0, -2.0, 0.0))


def test_negate_exchanges_dark_and_light(tmp_path):
    cells = read_occupancy_grid(write(tmp_path, negate=1), 'map').cells
    np.testing.assert_array_equal(cells[0], CELLS[0])


def test_points_fall_into_the_cells_of_a_turned_grid():
    grid = OccupancyGrid('map', CELLS, 0.5, (1.0, -2.0, math.pi / 2))
    # columns run along y, rows along -x
    points = np.array([[0.9, -1.9], [0.9, -1.4], [0.4, -1.9], [0.4, -1.4], [1.1, -1.9],
                       [np.nan, 0.0], [1e300, -1e300]])
    np.testing.assert_array_equal(
        grid.at(points), [FREE, OCCUPIED, UNKNOWN, FREE, UNKNOWN, UNKNOWN, UNKNOWN])


def test_the_cells_around_a_point_include_its_own():
    grid = OccupancyGrid('map', CELLS, 0.5, (0.0, 0.0, 0.0))
    assert grid.around(np.array([0.75, 0.25]), 0.01)[0] == OCCUPIED
    assert set(grid.around(np.array([0.75, 0.25]), 0.5).tolist()) == {FREE, OCCUPIED, UNKNOWN}


def test_a_way_is_blocked_by_a_wall_between_its_ends_only():
    cells = np.zeros((10, 100), dtype=np.int8)
    cells[:, 50] = OCCUPIED
    grid = OccupancyGrid('map', cells, 0.1, (0.0, 0.0, 0.0))
    ends = np.array([[9.0, 0.5], [4.9, 0.5], [5.3, 0.5], [0.5, 0.5]])
    start, stop = np.array([0.5, 0.5]), np.full(4, 0.1)
    assert grid.are_blocked(start, ends, 0.3, stop).tolist() == [True, False, True, False]
    assert not grid.are_blocked(start, ends, 0.3, np.array([4.1, 0.1, 0.4, 0.1])).any()
    assert not grid.are_blocked(np.array([4.9, 0.5]), ends[:1], 0.3, stop[:1]).any(), 'skipped'
    assert grid.are_blocked(start, ends[:0], 0.3, stop[:0]).shape == (0,)


@pytest.mark.parametrize(('before', 'after', 'text'), [
    ('image: walls', 'image: gone', 'gone.pgm'),
    ('resolution: 0.5\n', '', "'resolution' is miss"), ('0.5', '0.0', 'resolution 0.0'),
    ('[1.0, -2.0, {yaw}]', '[1.0, .inf, 0.0]', 'origin'), ('0.196', '0.9', 'must rise'),
    (YAML, 'walls', 'no YAML mapping'), ('negate: {negate}', 'negate: maybe', 'maybe')])
def test_a_damaged_file_is_refused_by_name(tmp_path, before, after, text):
    file = write(tmp_path, text=YAML.replace(before, after))
    with pytest.raises(MapError, match=str(file)) as caught:
        read_occupancy_grid(file, 'map')
    assert text in str(caught.value)
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('suffix', ['pgm', 'png'])
def test_an_image_that_is_cut_short_is_refused(tmp_path, suffix):
    file = write(tmp_path, suffix)
    data = (tmp_path / f'walls.{suffix}').read_bytes()
    for length in (0, 2, 5, len(data) - 5):
        (tmp_path / f'walls.{suffix}').write_bytes(data[:length])
        with pytest.raises(MapError, match=r'neither PGM|damaged'):
            read_occupancy_grid(file, 'map')


@pytest.mark.parametrize('header', [b'P5\n# saved\n20000 20000\n255\n', b'P5 0 5 255\n'])
def test_a_size_is_refused_before_the_image_is_decoded(tmp_path, header):
    file = write(tmp_path)
    (tmp_path / 'walls.pgm').write_bytes(header)
    with pytest.raises(MapError, match='cells: must be 1 to 64000000'):
        read_occupancy_grid(file, 'map')
