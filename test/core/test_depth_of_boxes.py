# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Depth of boxes and of images: correct depth helps, wrong depth does no harm."""

from dataclasses import replace

import numpy as np
import pytest
from scene import CAMERA, MAP_FROM_CAMERA, ROOM, SEEN, rigid
from scipy.spatial.transform import Rotation

from cliploc_ros.core.acceptance.depth_check import DepthCheck, DepthScale
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.depth import (
    DepthCamera,
    DepthImage,
    depth_from_counts,
    depths_of_boxes,
    half_chord,
)
from cliploc_ros.core.geometry.transforms import invert_transform, pose_error
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import DatasetError, OptionsError
from studies.worlds.depths import simulate_depths

CAMERA_FROM_MAP = invert_transform(MAP_FROM_CAMERA)
ROTATION = np.ascontiguousarray(CAMERA_FROM_MAP[:3, :3])
TRANSLATION = np.ascontiguousarray(CAMERA_FROM_MAP[:3, 3])
RELOCALIZER = Relocalizer(ROOM, RelocalizerOptions(matching='class', tilt_deviation_deg=0.0))
NONE = np.full(len(ROOM), np.nan)


def look(rng, noise_px=4.0):
    """Return noisy boxes of all objects, and their depths."""
    seen = replace(SEEN, bboxes_xyxy=SEEN.bboxes_xyxy + rng.normal(0.0, noise_px, (len(ROOM), 4)))
    return Observation(CAMERA, seen, depths=simulate_depths(ROOM.centers, ROOM.shapes,
                                                            MAP_FROM_CAMERA, rng))


def error_m(found):
    return pose_error(found.map_from_camera, MAP_FROM_CAMERA)[0]


def test_the_chord_is_that_of_the_ray_through_the_centre():
    eye = MAP_FROM_CAMERA[:3, 3]
    for center, shape, axes, quat in zip(ROOM.centers, ROOM.shapes, ROOM.semi_axes,
                                         ROOM.quats_xyzw, strict=True):
        basis = Rotation.from_quat(quat).as_matrix() / axes
        inverse = basis @ basis.T
        ray = center - eye
        # the surface is where (s - 1)^2 ray^T S^-1 ray = 1
        depth = (ROTATION @ center + TRANSLATION)[2]
        expected = depth / np.sqrt(ray @ inverse @ ray)
        assert half_chord(center, shape, ROTATION, TRANSLATION) == pytest.approx(expected)


@pytest.mark.once
def test_right_depth_makes_poses_better_and_surer():
    rng, errors, deviations = np.random.default_rng(0), [], []
    for _ in range(40):
        one = look(rng, noise_px=8.0)
        pair = [RELOCALIZER.relocalize([replace(one, depths=depths)])
                for depths in (None, one.depths)]
        if all(found.solved and error_m(found) < 1.0 for found in pair):
            errors.append([error_m(found) for found in pair])
            deviations.append([np.sqrt(np.trace(found.covariance[:3, :3])) for found in pair])
    assert len(errors) >= 33
    assert np.median(errors, axis=0)[1] < np.median(errors, axis=0)[0]
    assert np.median(deviations, axis=0)[1] < 0.95 * np.median(deviations, axis=0)[0]


@pytest.mark.parametrize('change', [
    lambda depths, rng: 1.6 * depths, lambda depths, rng: rng.uniform(0.5, 9.0, len(depths)),
    lambda depths, rng: NONE, lambda depths, rng: 0.0 * depths, lambda depths, rng: depths / 0.0],
    ids=['scale', 'random', 'none', 'zero', 'infinite'])
@pytest.mark.filterwarnings('ignore:divide by zero')
def test_wrong_depth_and_none_do_no_harm(change):
    rng = np.random.default_rng(3)
    for _ in range(8):
        one = look(rng)
        alone = RELOCALIZER.relocalize([replace(one, depths=None)])
        found = RELOCALIZER.relocalize([replace(one, depths=change(one.depths, rng))])
        assert found.accepted == alone.accepted
        assert found.depth is None or not found.depth.is_passed
        np.testing.assert_array_equal(found.map_from_camera, alone.map_from_camera)
        # a mirror image is also judged without depth
        assert found.confidence == alone.confidence


def test_depths_of_another_number_of_boxes_are_refused(rng):
    with pytest.raises(OptionsError, match='12 detections'):
        RELOCALIZER.relocalize([replace(look(rng), depths=NONE[1:])])


def test_depth_of_a_wrong_scale_is_used_no_more(rng):
    localizer = Localizer(RELOCALIZER)
    for number in range(5):
        assert not localizer.depth_scale.is_wrong
        one = look(rng)
        localizer.answer(Query((replace(one, depths=1.5 * one.depths, stamp_ns=number),)))
    assert localizer.depth_scale.is_wrong
    assert localizer.depth_scale.ratio == pytest.approx(1.5, abs=0.1)
    assert localizer.answer(Query((look(rng),))).depth is None


def test_depth_is_off_by_eight_percent_at_most():
    """As doc/interface.md states: five accepted poses decide, by their median."""
    for ratio, is_wrong in {0.92: True, 0.93: False, 1.07: False, 1.09: True}.items():
        scale = DepthScale()
        for number, one in enumerate([ratio, 1.0, ratio, 1.0, ratio], 1):
            scale.add(DepthCheck(4, 0.0, 0.0, one))
            assert scale.ratio == (ratio if number == 5 else 1.0)
        assert scale.is_wrong == is_wrong


COLOR = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)


def test_depth_of_boxes_is_robust():
    depths = np.full((480, 640), 4.0, dtype=np.float32)  # a wall
    depths[100:200, 100:200] = 2.0  # an object, whose box is a little too large
    depths[140:150, 100:200] = np.nan  # a hole
    depths[300:400, 300:400] = np.nan
    found, spreads = depths_of_boxes(DepthImage(depths), COLOR, np.array([
        [90.0, 90.0, 210.0, 210.0], [305.0, 305.0, 395.0, 395.0], [600.0, 400.0, 700.0, 500.0],
        [120.0, 120.0, 122.0, 122.0]]))
    np.testing.assert_allclose(found, [2.0, np.nan, 4.0, np.nan])
    np.testing.assert_allclose(spreads[[0, 2]], 0.0)
    smaller, _ = depths_of_boxes(DepthImage(depths[::2, ::2]), COLOR, np.array([
        [90.0, 90.0, 210.0, 210.0], [305.0, 305.0, 395.0, 395.0]]))
    np.testing.assert_allclose(smaller, [2.0, np.nan])


def test_depth_that_is_not_registered():
    own = DepthCamera(585.0, 585.0, 320.0, 240.0, rigid((-0.025, 0.0, 0.0)))
    depths = np.full((480, 640), 4.0, dtype=np.float32)
    depths[200:280, 400:480] = 1.0
    # position in the colour camera: scaled by .897, shifted by 525 * 25 mm / 1 m = 13 px
    left = 320 + (400 - 320) * 525 / 585 - 13.125
    box = np.array([[left, 204.1, left + 71.8, 275.9]])
    found, spread = depths_of_boxes(DepthImage(depths, own), COLOR, box)
    np.testing.assert_allclose([found[0], spread[0]], [1.0, 0.0], atol=1e-6)
    # a depth camera on its side, with its x axis along the other's y axis
    aside = DepthCamera(585.0, 585.0, 240.0, 639.0 - 320.0,
                        own.color_from_depth @ rigid(degrees=90.0))
    found, spread = depths_of_boxes(DepthImage(np.rot90(depths), aside), COLOR, box)
    np.testing.assert_allclose([found[0], spread[0]], [1.0, 0.0], atol=1e-6)
    # if taken for registered, the box further left shows the wall
    box = box - [20, 0, 20, 0]
    assert depths_of_boxes(DepthImage(depths), COLOR, box)[0][0] == 4.0
    assert depths_of_boxes(DepthImage(depths, own), COLOR, box)[0][0] == 1.0


def test_counts_and_floats_are_depths_in_metres():
    counts = np.array([[0, 65535, 1500]], dtype=np.uint16)
    np.testing.assert_allclose(depth_from_counts(counts, None, 'x'), [[np.nan, np.nan, 1.5]])
    metres = np.array([[0.0, np.inf, 1.5]])
    np.testing.assert_allclose(depth_from_counts(metres, None, 'x'), [[np.nan, np.nan, 1.5]])
    with pytest.raises(DatasetError, match='16-bit'):
        depth_from_counts(np.zeros((2, 2, 3), dtype=np.uint8), None, 'x')
