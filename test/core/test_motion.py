# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Two looks with odometry between them: a room moves as odometry predicts, a picture does not."""

import numpy as np
import pytest
from scene import rigid
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from cliploc_ros.core.acceptance.genuine import compare_motion
from cliploc_ros.core.fit.covariance import odometry_deviations
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform
from cliploc_ros.core.keyframes.layer import FROM_DEPTH
from cliploc_ros.core.keyframes.places import RecognizedPlace
from cliploc_ros.core.keyframes.point_pose import find_pose

SHARED = np.diag([0.012**2] * 3 + [np.radians(0.45)**2] * 3)
SURE = chi2.isf(1e-3, 6)


def turned(degrees, behind_m=0.0):
    """Return the motion of a camera that turns to the right about an axis behind it."""
    turn = rigid(axis='y', degrees=degrees)[:3, :3]
    return make_transform(turn, (turn - np.eye(3)) @ np.array([0.0, 0.0, behind_m]))


MOTIONS = {'side': rigid((0.2, 0, 0)), 'oblique': rigid((0.15, 0, 0.15)),
           'turn': turned(10.0, 0.5), 'back and turn': rigid((-0.2, 0, -0.1)) @ turned(10.0)}


@pytest.fixture
def room():
    """Return points 1.5 to 5 m in front of a camera, and their bearings."""
    rng = np.random.default_rng(1)
    bearings = rng.uniform((-0.6, -0.45), (0.6, 0.45), (300, 2))
    pose = make_transform(Rotation.from_rotvec([0.5, -1.0, 0.3]).as_matrix(),
                          np.array([3.0, 1.0, 2.0]))
    depths = rng.uniform(1.5, 5.0, (300, 1))
    return pose, depths * np.column_stack([bearings, np.ones(300)]) @ pose[:3, :3].T + pose[:3, 3]


def seen_from(points, pose):
    inside = (points - pose[:3, 3]) @ pose[:3, :3]
    return inside[:, :2] / inside[:, 2:]


def on_picture(bearings, first_from_second, away_m):
    """Return bearings after a motion by the homography of a plane that faced the first camera."""
    back = invert_transform(first_from_second)
    plane = back[:3, :3] + np.outer(back[:3, 3], [0.0, 0.0, 1.0]) / away_m
    moved = np.column_stack([bearings, np.ones(len(bearings))]) @ plane.T
    return moved[:, :2] / moved[:, 2:]


def look(points, bearings, rng, keyframe=0, wrong=None):
    """Return the place where such an image is recognized, in keyframes with a wrong pose."""
    noise = rng.normal(0.0, 0.5 / 525.0, bearings.shape)
    found = find_pose(points, bearings + noise)
    pose = found.map_from_camera if wrong is None else wrong @ found.map_from_camera
    return RecognizedPlace(
        pose, 20.0 * found.covariance + SHARED, SHARED, len(found.inliers), 0.8, 0.8,
        keyframes=(keyframe,), shares=(1.0,), points=points[found.inliers])


@pytest.mark.parametrize('name', MOTIONS)
def test_a_room_moves_as_odometry_says_and_a_picture_does_not(room, name):
    pose, points = room
    motion, rng = MOTIONS[name], np.random.default_rng(2)
    bearings, squares = seen_from(points, pose), []
    for _ in range(8):
        deviations = odometry_deviations(motion) * rng.normal(size=6)
        odometry = motion @ make_transform(Rotation.from_rotvec(deviations[3:]).as_matrix(),
                                           deviations[:3])
        first = look(points, bearings, rng)
        second = look(points, seen_from(points, pose @ motion), rng)
        found = compare_motion(FROM_DEPTH, first, second, odometry)
        squares.append(found.square)
        assert found.picture > SURE
        for away_m in (1.0, 2.0, 3.0):
            second = look(points, on_picture(bearings, motion, away_m), rng)
            assert compare_motion(FROM_DEPTH, first, second, odometry).square > SURE
    assert max(squares) < SURE
    assert np.mean(squares) < 8.0


@pytest.mark.parametrize('motion', [np.eye(4), turned(10.0), rigid((0.01, 0, 0))],
                         ids=['none', 'about the camera itself', '1 cm'])
def test_where_a_picture_moves_like_the_room_nothing_is_claimed(room, motion):
    pose, points = room
    rng = np.random.default_rng(3)
    bearings = seen_from(points, pose)
    first = look(points, bearings, rng)
    for second in (seen_from(points, pose @ motion), on_picture(bearings, motion, 2.0)):
        found = compare_motion(FROM_DEPTH, first, look(points, second, rng), motion)
        assert found.picture < chi2.isf(0.05, 6)
        assert found.square < SURE


def test_a_picture_that_the_camera_passes_is_not_seen_again(room):
    pose, points = room
    rng, motion = np.random.default_rng(5), rigid((0, 0, 5.0))
    first = look(points, seen_from(points, pose), rng)
    found = compare_motion(FROM_DEPTH, first, first._replace(map_from_camera=pose @ motion),
                           motion)
    assert found.picture == np.inf
    assert found.square < SURE


def test_what_looks_at_the_same_keyframes_share_does_not_count(room):
    """A wrong keyframe pose moves both poses alike; errors of two keyframes differ."""
    pose, points = room
    rng, motion = np.random.default_rng(4), rigid((0.2, 0, 0))
    wrong = rigid((0.04, 0.0, 0.0), degrees=1.2)
    bearings, moved = seen_from(points, pose), seen_from(points, pose @ motion)
    first = look(points, bearings, rng)
    same, other = (compare_motion(FROM_DEPTH, first,
                                  look(points, moved, rng, keyframe, wrong), motion)
                   for keyframe in (0, 1))
    assert other.square < SURE < same.square
    assert other.picture < 0.7 * same.picture
    first = look(points, bearings, rng, wrong=wrong)
    both = compare_motion(FROM_DEPTH, first, look(points, moved, rng, wrong=wrong), motion)
    assert both.square < SURE
