# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cameras that no image has are certain faults, odd ones are doubts, and valid ones neither."""

import numpy as np
import pytest

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.camera_faults import camera_faults, fields_of_view
from cliploc_ros.offline.datasets.intrinsics import PRESETS, read_camera

SOUND = {'width': 640, 'height': 480, 'fx': 525.0, 'fy': 525.0, 'cx': 320.0, 'cy': 240.0}
FISHEYE = {'distortion_model': 'equidistant', 'distortion': (-0.02, 0.01, -0.005, 0.001)}
BARREL = {'distortion_model': 'plumb_bob', 'distortion': (-0.35, 0.12, 0.001, -0.001, 0.0)}


def judged(changes):
    """Return 'refused', 'doubted' or 'sound'."""
    faults = camera_faults(Camera(**(SOUND | changes)))
    return 'sound' if not faults else 'refused' if faults[0].is_certain else 'doubted'


@pytest.mark.parametrize('changes', [
    {}, {'distortion_model': 'plumb_bob', 'distortion': (0.0,) * 5}, BARREL,
    {'distortion_model': 'rational_polynomial',
     'distortion': (1.0, 0.2, 0.001, -0.0005, 0.01, 1.3, 0.5, 0.05)},
    {'cx': 384.0}, {'cy': 192.0}, {'cx': 288.0, 'cy': 264.0}, {'fy': 541.0},
    {'width': 360, 'height': 640, 'cx': 180.0, 'cy': 320.0, 'fx': 500.0, 'fy': 500.0},
    {'width': 80, 'height': 60, 'cx': 40.0, 'cy': 30.0, 'fx': 75.0, 'fy': 75.0},
    {'fx': 300.0, 'fy': 300.0}, {'fx': 5000.0, 'fy': 5000.0},
    {'fx': 244.5, 'fy': 244.5, **FISHEYE}, {'fx': 180.0, 'fy': 180.0, **FISHEYE}])
def test_valid_odd_cameras_are_sound(changes):
    """Among them 10 % off the middle, fx and fy 3 % apart, portrait, thermal, fisheyes."""
    assert judged(changes) == 'sound'


@pytest.mark.parametrize(('changes', 'verdict'), [
    ({'fx': 1050.0, 'fy': 1050.0, 'cx': 640.0, 'cy': 480.0}, 'refused'),  # of twice the size
    ({'fx': 262.5, 'fy': 262.5, 'cx': 160.0, 'cy': 120.0}, 'refused'),  # of half the size
    ({'fx': 1050.0, 'fy': 788.0, 'cx': 640.0, 'cy': 360.0}, 'refused'),  # of 1280x720
    ({'cx': 0.0, 'cy': 0.0}, 'refused'), ({'cx': -320.0}, 'refused'),
    ({'cx': 424.0}, 'doubted'), ({'fx': 0.82, 'fy': 1.09}, 'refused'),  # in sizes of the image
    ({'fx': 4.2, 'fy': 4.2}, 'refused'), ({'fx': 1e6, 'fy': 1e6}, 'refused'),  # in mm, in nm
    ({'fx': 150.0, 'fy': 150.0}, 'doubted'), ({'fx': 2e4, 'fy': 2e4}, 'doubted'),
    ({'fx': 0.7, 'fy': 0.9, **FISHEYE}, 'refused'), ({'fx': 140.0, 'fy': 140.0, **FISHEYE},
                                                     'doubted'),
    ({'fx': 700.0}, 'doubted'), ({'fx': 1400.0}, 'refused'),
    # the coefficients of another lens, or in another order
    ({'distortion_model': 'plumb_bob', 'distortion': (-6.0, 0.0, 0.0, 0.0)}, 'refused'),
    ({'distortion_model': 'plumb_bob', 'distortion': (-1.0, 0.0, 0.0, 0.0)}, 'doubted')])
def test_cameras_that_no_image_has(changes, verdict):
    assert judged(changes) == verdict


def test_recorded_cameras_are_sound(shared_data):
    cameras = [*PRESETS.values(), *map(read_camera, shared_data.glob('**/camera.json'))]
    assert len(cameras) >= 7
    assert [camera_faults(one) for one in cameras] == [()] * len(cameras)


def test_the_field_of_view_is_that_of_the_lens():
    lens = SOUND | {'fx': 320.0, 'fy': 240.0}
    assert fields_of_view(Camera(**lens)) == pytest.approx((90.0, 90.0))
    assert fields_of_view(Camera(**lens, **FISHEYE)) == pytest.approx(np.degrees((2.0, 2.0)))
