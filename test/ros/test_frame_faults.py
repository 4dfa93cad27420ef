# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Each field of camera_info and of the headers, broken in turn, and unusual but valid values."""

import numpy as np
import pytest
from scene import CAMERA
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, RegionOfInterest

from cliploc_ros import messages
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.core.observation import OPTICAL_FROM_BODY
from cliploc_ros.errors import CameraError
from cliploc_ros.ros.frame_localizer import faults_of_axes

SIZE = (CAMERA.width, CAMERA.height)
K = [500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0]
P = [500.0, 0.0, 320.0, 0.0, 0.0, 500.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]
BARREL = {'d': [-0.35, 0.12, 0.001, -0.001, 0.0],
          'p': [420.0, 0.0, 316.0, 0.0, 0.0, 450.0, 238.0, 0.0, 0.0, 0.0, 1.0, 0.0]}
FISHEYE = {'distortion_model': 'equidistant', 'd': [0.0] * 4, 'p': [0.0] * 12}
RIGHT = {'p': [400.0, 0.0, 310.0, -48.0, *P[4:]]}
TURNED = Rotation.from_euler('y', 12.0, degrees=True).as_matrix().ravel()


def judged(changes, rectified=False):
    """Return 'refused', 'doubted' or 'sound', and the reason."""
    fields = {'width': SIZE[0], 'height': SIZE[1], 'distortion_model': 'plumb_bob',
              'd': [0.0] * 5, 'k': K, 'p': P, 'r': np.eye(3).ravel()} | changes
    msg = CameraInfo(**{name: value if isinstance(value, (int, str, RegionOfInterest)) else [
        *map(float, value)] for name, value in fields.items()})
    try:
        camera = messages.camera_from_msg(msg, SIZE, rectified)
        faults = messages.faults_of_camera_info(msg, camera, rectified)
    except CameraError as error:
        return 'refused', str(error)
    text = '; '.join(fault.text for fault in faults)
    return ('sound' if not faults else 'refused' if faults[0].is_certain else 'doubted'), text


def with_element(name, matrix, place, value):
    return {name: [*matrix[:place], value, *matrix[place + 1:]]}


@pytest.mark.parametrize(('changes', 'verdict', 'names'), [
    *((with_element('k', K, place, value), verdict, 'K') for place, value, verdict in (
        (0, 0.0, 'refused'), (0, -500.0, 'refused'), (0, 1000.0, 'refused'), (1, 20.0, 'refused'),
        (2, 640.0, 'refused'), (3, 5.0, 'refused'), (4, 250.0, 'refused'), (5, 480.0, 'refused'),
        (6, 320.0, 'refused'), (7, 240.0, 'refused'), (8, 0.0, 'refused'),
        (5, float('nan'), 'refused'))),
    *((with_element('p', P, place, value), 'doubted', 'P') for place, value in (
        (0, 550.0), (1, 20.0), (2, 640.0), (3, -60.0), (4, 5.0), (5, 450.0), (6, 480.0),
        (7, -60.0), (8, 1.0), (9, 1.0), (10, 0.0), (11, 1.0), (0, -500.0), (6, float('nan')))),
    (with_element('p', P, 5, 250.0), 'refused', 'P'),
    (with_element('p', P, 3, -60_000.0), 'refused', '1.2e+02 m beside'),  # in millimetres
    ({'k': np.reshape(K, (3, 3)).T.ravel()}, 'refused', 'transposed'),
    # without P, unusual pixel shapes are possible
    (with_element('k', K, 0, 1000.0) | {'p': [0.0] * 12}, 'doubted', 'K'),
    (with_element('k', K, 2, 424.0), 'refused', 'P'),
    *(({'k': [focal, 0.0, 320.0, 0.0, focal, 240.0, 0.0, 0.0, 1.0]}, verdict, 'P')
      for focal, verdict in ((1000.0, 'refused'), (390.0, 'refused'), (550.0, 'doubted'))),
    ({'k': [505.0, 0.0, 320.0, 0.0, 505.0, 240.0, 0.0, 0.0, 1.0]}, 'sound', ''),
    ({'p': [250.0, 0.0, 160.0, 0.0, 0.0, 250.0, 120.0, *P[7:]]}, 'doubted', 'P'),
    ({'k': [1000.0, 0.0, 640.0, 0.0, 1000.0, 480.0, 0.0, 0.0, 1.0]}, 'refused', '1280x960'),
    ({'k': [250.0, 0.0, 160.0, 0.0, 250.0, 120.0, 0.0, 0.0, 1.0]}, 'refused', '320x240'),
    # without a size only the principal point can be checked
    ({'width': 0, 'height': 0, 'k': [1000.0, 0.0, 640.0, 0.0, 1000.0, 480.0, 0.0, 0.0, 1.0]},
     'refused', '1280x960'),
    ({'width': 480}, 'refused', '480x'), ({'height': 640}, 'refused', '640x640'),
    ({'binning_x': 2}, 'refused', 'binning 2x1'), ({'binning_y': 2}, 'refused', 'binning 1x2'),
    ({'roi': RegionOfInterest(width=320, height=240)}, 'refused', 'roi 320x240'),
    ({'roi': RegionOfInterest(x_offset=100)}, 'refused', 'roi 0x0 at'),
    ({'r': TURNED}, 'doubted', '12 degrees'), ({'r': 2.0 * np.eye(3).ravel()}, 'doubted', 'R'),
    ({'r': np.diag([1.0, 1.0, -1.0]).ravel()}, 'doubted', 'R'),
    ({'r': [float('nan')] * 9}, 'doubted', 'R'),
    *(({'distortion_model': name, 'd': d}, 'refused', name) for name in (
        'fisheye', 'mystery') for d in ([0.0] * 4, [])),
    ({'distortion_model': ''}, 'sound', ''),
    ({'distortion_model': '', 'd': [0.1]}, 'refused', "''"),
    ({'d': [0.1] * 3}, 'refused', '4 or 5'), ({'d': [0.1] * 6}, 'refused', '4 or 5'),
    *(({'distortion_model': 'rational_polynomial', 'd': [0.1] * count}, 'refused', str(count))
      for count in (7, 13)),
    *((FISHEYE | {'d': [0.0] * count}, 'refused', str(count)) for count in (0, 3, 5)),
    ({'d': [float('nan')] * 5}, 'refused', 'not finite'),
    ({'d': [-6.0, 0.0, 0.0, 0.0]}, 'refused', 'fold'),
    (BARREL | {'p': [900.0, *P[1:]]}, 'doubted', 'resolution')])
def test_each_field_of_camera_info(changes, verdict, names):
    found, reason = judged(changes)
    assert found == verdict
    assert names in reason


@pytest.mark.parametrize(('changes', 'verdict'), [
    (RIGHT | {'r': TURNED} | {'d': BARREL['d']}, 'doubted'),  # may be in the left's frame
    (with_element('p', P, 1, 9.0), 'refused'), ({'p': [0.0] * 12}, 'refused'),
    (with_element('p', P, 5, 1400.0), 'refused'), (with_element('p', P, 2, 640.0), 'refused'),
    (with_element('p', P, 10, 0.0), 'refused')])
def test_rectified_images_are_judged_by_p(changes, verdict):
    assert judged(changes, rectified=True)[0] == verdict


@pytest.mark.parametrize(('changes', 'rectified'), [
    ({}, False), ({}, True), ({'d': []}, False), ({'p': [0.0] * 12}, False),
    ({'r': [0.0] * 9}, False), (BARREL, False), (BARREL | {'r': TURNED}, True),
    ({'k': [0.0] * 9, 'd': [0.5] * 5}, True), ({'d': [0.0] * 8}, False),
    ({'distortion_model': 'rational_polynomial'}, False), (FISHEYE, False),
    (FISHEYE | {'k': [240.0, 0.0, *K[2:4], 240.0, *K[5:]]}, False),
    # a crop of the sensor's corner, and 2 x 2 binning
    ({'width': 1920, 'height': 1200, 'k': [1400.0, 0.0, 960.0, 0.0, 1400.0, 600.0, 0.0, 0.0, 1.0],
      'p': [0.0] * 12, 'roi': RegionOfInterest(x_offset=1280, y_offset=720, width=640,
                                               height=480)}, False),
    ({'width': 1280, 'height': 960, 'k': [1000.0, 0.0, 640.0, 0.0, 1000.0, 480.0, 0.0, 0.0, 1.0],
      'p': [0.0] * 12, 'binning_x': 2, 'binning_y': 2}, False),
    ({'width': 0, 'height': 0}, False),
    ({'k': [500.0, 0.0, 320.0, 0.0, 515.0, 264.0, 0.0, 0.0, 1.0], 'p': [0.0] * 12}, False)])
def test_valid_odd_messages_are_sound(changes, rectified):
    assert judged(changes, rectified) == ('sound', '')


@pytest.mark.parametrize(('frames', 'certain'), [
    (('/camera', 'camera', 'camera/'), []), (('camera', '', ''), []),
    (('left', 'left', 'right'), [True]), (('left', 'right', ''), [False]),
    (('left', 'right', 'right'), [True, False])])
def test_messages_of_another_coordinate_frame(frames, certain):
    assert [fault.is_certain for fault in messages.faults_of_headers(*frames)] == certain


@pytest.mark.parametrize('tilt_deg', [-40.0, 30.0])
def test_a_body_frame_in_place_of_an_optical_one(tilt_deg):
    """The camera's pose on a robot shows whether it looks at the ceiling."""
    base_from_body = make_transform(
        Rotation.from_euler('ZY', [70.0, tilt_deg], degrees=True).as_matrix(), np.zeros(3))
    base_from_optical = base_from_body @ invert_transform(OPTICAL_FROM_BODY)
    assert faults_of_axes('camera', invert_transform(base_from_optical)) == []
    mount = invert_transform(base_from_body)
    assert [fault.is_certain for fault in faults_of_axes('camera', mount)] == [False]


@pytest.mark.parametrize(('topic', 'rectified', 'changes', 'certain'), [
    ('/camera/image_rect', False, RIGHT, [True]), ('/camera/image_rect', False, FISHEYE, [True]),
    ('/camera/image_rect_color/compressed', False, BARREL, [True]),
    ('/camera/image_rect', False, {}, []),  # no rectification needed
    ('/rect/image', False, BARREL, [False]), ('/camera/image_rect', True, BARREL, []),
    ('/camera/image_raw', False, BARREL, []), ('/infra1/image_rect_raw', False, {}, []),
    ('/camera/image_raw/compressed', True, BARREL, [False]), ('/camera/image_raw', True, {}, []),
    ('/camera/image', True, BARREL, []), ('/rectangle/image', False, BARREL, []),
    ('/camera/image_rectangles', False, BARREL, []), ('/image_rectified', False, BARREL, [True])])
def test_images_that_sound_rectified_or_raw(topic, rectified, changes, certain):
    fields = {'distortion_model': 'plumb_bob', 'd': [0.0] * 5, 'k': K, 'p': P} | changes
    found = messages.faults_of_rectified(topic, rectified, CameraInfo(**fields))
    assert [fault.is_certain for fault in found] == certain
