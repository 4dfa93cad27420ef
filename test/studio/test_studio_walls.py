# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The studio's walls: files of nav2_map_server, valid and damaged."""

import cv2
import numpy as np
import pytest

from cliploc_ros.errors import MapError
from cliploc_ros.offline.studio.room import FREE, OCCUPIED, UNKNOWN, read_walls

# the last row is at the origin: y up
CELLS = np.array([[UNKNOWN, FREE, FREE], [FREE, OCCUPIED, FREE]], dtype=np.uint8)
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
    image = np.choose(CELLS, [205, 254, 0]).astype(np.uint8)
    cv2.imwrite(str(folder / f'walls.{suffix}'), 255 - image if negate else image)
    (folder / 'walls.yaml').write_text(text.format(suffix=suffix, negate=negate, yaw=yaw))
    return folder / 'walls.yaml'


@pytest.mark.parametrize(('suffix', 'negate'), [('pgm', 0), ('png', 0), ('pgm', 1)])
def test_a_file_of_map_server_is_read(tmp_path, suffix, negate):
    grid = read_walls(write(tmp_path, suffix, negate))
    np.testing.assert_array_equal(grid.cells[negate:], CELLS[negate:])
    assert (grid.resolution_m, grid.origin) == (0.5, (1.0, -2.0, 0.0))


@pytest.mark.parametrize(('before', 'after', 'text'), [
    ('image: walls.{suffix}', 'image: /dev/zero', 'not an image'), ('trinary', 'raw', 'mode raw'),
    ('resolution: 0.5\n', '', "'resolution' is miss"), ('0.5', '0.0', 'resolution 0.0'),
    ('[1.0, -2.0, {yaw}]', '[1.0, .inf, 0.0]', 'origin'), ('0.196', '0.9', 'free_thresh'),
    ('negate: {negate}', 'negate: maybe', 'maybe')])
def test_a_damaged_file_is_refused_by_name(tmp_path, before, after, text):
    file = write(tmp_path, text=YAML.replace(before, after))
    with pytest.raises(MapError, match=str(file)) as caught:
        read_walls(file)
    assert text in str(caught.value)
    assert '\n' not in str(caught.value)


def test_an_image_that_is_cut_short_is_refused(tmp_path):
    file, image = write(tmp_path), tmp_path / 'walls.pgm'
    data = image.read_bytes()
    for length in (0, 5, len(data) - 5):
        image.write_bytes(data[:length])
        with pytest.raises(MapError, match=r'missing, damaged or not an image'):
            read_walls(file)
