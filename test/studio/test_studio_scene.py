# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The studio's scene: surfaces, walls, labels, colours, and the viewpoint of a person."""

import io
from contextlib import redirect_stdout
from dataclasses import replace

import cv2
import numpy as np
import pytest
import viser
from scene import make_layer
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.depth import DepthImage
from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.errors import MapError
from cliploc_ros.offline.datasets.frames import RawFrame
from cliploc_ros.offline.datasets.images import Images
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.studio import room, viewpoint
from cliploc_ros.offline.studio.edits import map_of
from cliploc_ros.offline.studio.recording import Recording
from cliploc_ros.offline.studio.scene import Layers, draw_answers

CAMERA = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
UPRIGHT = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # looks along x


@pytest.fixture
def server():
    with redirect_stdout(io.StringIO()):
        server = viser.ViserServer('127.0.0.1', 0, verbose=False)
    yield server
    server.stop()


def test_depth_becomes_a_cloud_below_the_ceiling():
    """A camera at x = 3, 1 m above the floor, sees a wall 2 m ahead that is red on the left."""
    image = np.zeros((48, 64, 3), dtype=np.uint8)
    image[:, :32, 0] = 200
    depth = DepthImage(np.full((48, 64), 2.0, dtype=np.float32))
    images = Images([RawFrame(0, 0, None, lambda: (image, CAMERA), lambda: depth)])
    poses = make_transform(UPRIGHT, np.array([3.0, 0.0, 1.0]))[None]
    views = PosedDetections((CAMERA,), poses, np.zeros(1), np.zeros(2, dtype=np.int64),
                            np.empty((0, 4)), (), np.empty(0, dtype=np.int64), np.empty(0))
    extent = viewpoint.extent_of([np.array([4.0, 0.0, 0.5])], poses)
    points, colors, _ = room.find_cloud(Recording(views, images), None, extent)
    assert len(points) > 50 and np.allclose(points[:, 0], 5.0, atol=1e-5)
    assert 1.0 < points[:, 2].max() < 1.3 < 1.8, 'no camera or landmark is higher than 1 m'
    is_red = colors[:, 0].astype(int) > colors[:, 1].astype(int)
    assert (points[is_red, 1] > -0.02).all() and (points[~is_red, 1] < 0.02).all()
    assert room.find_cloud(Recording(views), None, extent) is None


def test_points_of_keyframes_without_images_have_the_colours_of_their_height(studio):
    landmarks = studio.document.landmarks
    extent = viewpoint.extent_of([landmark.center for landmark in landmarks.values()], None)
    layer = replace(
        make_layer(map_of(landmarks), 1, points=2), map_from_camera=np.eye(4)[None],
        points=np.array([[0.0, 0.0, extent.floor_m], [0.0, 0.0, extent.top_m]], np.float32))
    points, colors, _ = room.find_cloud(studio.recording, layer, extent)
    low, top = colors[points[:, 2].argsort()].astype(int)
    assert low[0] > low[2] + 50 and top[2] > top[0] + 50, 'brown below, blue above'


@pytest.mark.parametrize('yaw', (0.0, 0.4))
def test_walls_lie_where_the_grid_has_them(server, yaw):
    cells = np.full((30, 40), room.UNKNOWN, dtype=np.uint8)
    cells[29 - 4, 33] = cells[29 - 20, 7] = room.OCCUPIED
    (handle,) = room.draw_walls(server.scene, room.Walls(cells, 0.1, (-1.0, 2.0, yaw)))
    rows, columns = np.nonzero(handle.image[..., 3])
    height, width = handle.image.shape[:2]
    across = np.column_stack([((columns + 0.5) / width - 0.5) * handle.render_width,
                              ((rows + 0.5) / height - 0.5) * handle.render_height,
                              np.zeros(len(rows))])
    turn = Rotation.from_quat(np.roll(handle.wxyz, -1))
    points = turn.apply(across) + handle.position
    in_grid = Rotation.from_euler('z', -yaw).apply(points - [-1.0, 2.0, 0.0])
    cells = {(int(y), int(x)) for x, y in np.floor(in_grid[:, :2] / 0.1)}
    assert cells == {(4, 33), (20, 7)}
    assert turn.apply([0.0, 0.0, 1.0])[2] == pytest.approx(-1.0), 'its face points up'


def test_other_answers_take_the_place_of_the_first_ones(server, studio, recwarn):
    """Viser warns of a node that was removed with its parent."""
    layers = Layers(server.scene)
    for view in (0, 5):
        layers.show('Answers', studio.recording.relocalize(
            studio.document.landmarks, [view], None), draw_answers)
    layers.show('Answers', None, draw_answers)
    assert not [str(warning.message) for warning in recwarn]


def test_up_is_found_where_the_map_is_in_a_cameras_frame():
    turns = Rotation.from_euler('z', np.linspace(0.0, 3.0, 20)[:, None]).as_matrix() @ UPRIGHT
    poses = np.array([make_transform(turn, np.zeros(3)) for turn in turns])
    assert viewpoint.extent_of([], poses).up.tolist() == [0.0, 0.0, 1.0]
    into_first = np.linalg.inv(poses[0]) @ poses
    assert np.allclose(viewpoint.extent_of([], into_first).up, [0.0, -1.0, 0.0], atol=1e-6)
    assert viewpoint.extent_of([], None).up.tolist() == [0.0, 0.0, 1.0]


# ---- files of nav2_map_server

# the last row is at the origin: y up
CELLS = np.full((2, 3), room.FREE, dtype=np.uint8)
CELLS[0, 0], CELLS[1, 1] = room.UNKNOWN, room.OCCUPIED
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
    grid = room.read_walls(write(tmp_path, suffix, negate))
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
        room.read_walls(file)
    assert text in str(caught.value)
    assert '\n' not in str(caught.value)


def test_an_image_that_is_cut_short_is_refused(tmp_path):
    file, image = write(tmp_path), tmp_path / 'walls.pgm'
    data = image.read_bytes()
    for length in (0, 5, len(data) - 5):
        image.write_bytes(data[:length])
        with pytest.raises(MapError, match=r'missing, damaged or not an image'):
            room.read_walls(file)
