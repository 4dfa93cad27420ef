# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The studio's floor: the files of nav2_map_server, sound and damaged."""

import cv2
import numpy as np
import pytest

from cliploc_ros.errors import MapError
from cliploc_ros.offline.studio.floor import FREE, OCCUPIED, UNKNOWN, read_occupancy_grid

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


@pytest.mark.parametrize(('suffix', 'negate'), [('pgm', 0), ('png', 0), ('pgm', 1)])
def test_a_file_of_map_server_is_read(tmp_path, suffix, negate):
    grid = read_occupancy_grid(write(tmp_path, suffix, negate))
    np.testing.assert_array_equal(grid.cells[:2 - negate], CELLS[:2 - negate])
    assert (grid.resolution_m, grid.origin) == (0.5, (1.0, -2.0, 0.0))


@pytest.mark.parametrize(('before', 'after', 'text'), [
    ('image: walls', 'image: gone', 'gone.pgm'),
    ('image: walls.{suffix}', 'image: /dev/zero', 'no file'), ('trinary', 'raw', 'mode raw'),
    ('resolution: 0.5\n', '', "'resolution' is miss"), ('0.5', '0.0', 'resolution 0.0'),
    ('[1.0, -2.0, {yaw}]', '[1.0, .inf, 0.0]', 'origin'), ('0.196', '0.9', 'must rise'),
    (YAML, 'walls', 'no YAML mapping'), ('negate: {negate}', 'negate: maybe', 'maybe')])
def test_a_damaged_file_is_refused_by_name(tmp_path, before, after, text):
    file = write(tmp_path, text=YAML.replace(before, after))
    with pytest.raises(MapError, match=str(file)) as caught:
        read_occupancy_grid(file)
    assert text in str(caught.value)
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('suffix', ['pgm', 'png'])
def test_an_image_that_is_cut_short_is_refused(tmp_path, suffix):
    file = write(tmp_path, suffix)
    data = (tmp_path / f'walls.{suffix}').read_bytes()
    for length in (0, 2, 5, len(data) - 5):
        (tmp_path / f'walls.{suffix}').write_bytes(data[:length])
        with pytest.raises(MapError, match=r'neither PGM|damaged'):
            read_occupancy_grid(file)


@pytest.mark.parametrize('header', [b'P5\n# saved\n20000 20000\n255\n', b'P5 0 5 255\n'])
def test_a_size_is_refused_before_the_image_is_decoded(tmp_path, header):
    file = write(tmp_path)
    (tmp_path / 'walls.pgm').write_bytes(header)
    with pytest.raises(MapError, match='1 to 64000000'):
        read_occupancy_grid(file)
