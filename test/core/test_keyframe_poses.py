# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses and points from matched features: exact cases, outliers, honest covariances."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cliploc_ros.core.fit.covariance import normalized_square
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform, pose_error
from cliploc_ros.core.keyframes import localization
from cliploc_ros.core.keyframes.features import (
    DIMENSIONS,
    Features,
    extract,
    match,
    unit_rows,
)
from cliploc_ros.core.keyframes.point_pose import LEAST_INLIERS, find_pose, free_focal
from cliploc_ros.core.search.scene import Constraint
from cliploc_ros.offline.recording.keyframe_layer import PosedFeatures, triangulate

CAMERA = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)


def look(rng, count=200, noise_px=0.0, offset=(0.0, 0.0, 0.0)):
    """Return a pose, points 1 to 4 m in front of it, and their bearings."""
    turn = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    pose = make_transform(turn, rng.normal(size=3) + offset)
    depths = rng.uniform(1.0, 4.0, count)
    bearings = rng.uniform((-0.6, -0.45), (0.6, 0.45), (count, 2))
    inside = np.column_stack([bearings, np.ones(count)]) * depths[:, None]
    points = inside @ pose[:3, :3].T + pose[:3, 3]
    return pose, points, bearings + rng.normal(0.0, noise_px / CAMERA.fx, bearings.shape)


@pytest.mark.parametrize('far_m', [0.0, 1e5], ids=['near', 'far from the origin'])
def test_a_pose_is_exact_without_noise_and_despite_outliers(far_m):
    rng = np.random.default_rng(1)
    pose, points, bearings = look(rng, offset=(far_m, 0.0, 0.0))
    bearings[:100] = rng.permutation(bearings[:100])
    found = find_pose(points, bearings)
    error_m, error_deg = pose_error(found.map_from_camera, pose)
    assert error_m < 1e-4
    assert error_deg < 1e-3
    assert set(found.inliers) >= set(range(100, 200))


def test_covariances_of_noisy_features_are_honest():
    rng, squares = np.random.default_rng(2), []
    for _ in range(60):
        pose, points, bearings = look(rng, 60, noise_px=1.0)
        found = find_pose(points, bearings)
        squares.append(normalized_square(found.map_from_camera, found.covariance, pose))
    # six degrees of freedom; the deviation of this mean is .45
    assert 4.0 < np.mean(squares) < 8.0


@pytest.mark.parametrize('ratio', [0.5, 0.8, 0.95, 1.0, 1.05, 1.25, 2.0])
def test_points_tell_the_focal_length_also_where_few_agree_with_the_given_one(ratio):
    rng = np.random.default_rng(12)
    _, points, bearings = look(rng, 400, noise_px=1.0)
    bearings[::4] = rng.permutation(bearings[::4])
    start = invert_transform(find_pose(points, bearings * ratio).map_from_camera)
    found, deviations, inliers = free_focal(points, bearings * ratio, start)
    assert (abs(found - (np.log(ratio), 0.0)) < 3.0 * deviations).all()
    assert (deviations < 0.004).all()
    assert len(inliers) > 250


def test_points_on_a_narrow_image_tell_its_aspect():
    rng = np.random.default_rng(15)
    _, points, bearings = look(rng, 400, noise_px=1.0)
    narrow = bearings * (0.7, 1.0)
    start = invert_transform(find_pose(points, narrow).map_from_camera)
    found, deviations, _ = free_focal(points, narrow, start)
    assert (abs(found - 0.5 * np.log(0.7)) < 3.0 * deviations).all()
    assert (deviations < 0.004).all()


def test_a_plane_that_fills_little_of_the_image_tells_no_focal_length():
    rng = np.random.default_rng(13)
    bearings = rng.uniform(-0.1, 0.1, (100, 2))
    points = 2.0 * np.column_stack([bearings, np.ones(100)])
    bearings += rng.normal(0.0, 1.0 / CAMERA.fx, bearings.shape)
    found = free_focal(points, bearings, np.eye(4))
    assert found is None or found[1][0] > 0.1


def test_few_points_and_points_that_agree_on_nothing_give_no_pose():
    rng = np.random.default_rng(3)
    _, points, bearings = look(rng, 30)
    assert find_pose(points[:5], bearings[:5]) is None
    assert find_pose(np.empty((0, 3)), np.empty((0, 2))) is None
    found = find_pose(points, rng.permutation(bearings))
    assert found is None or len(found.inliers) < 12
    assert find_pose(np.ones((20, 3)), np.zeros((20, 2))) is None


def test_the_place_in_more_parts_of_the_image_leads_before_a_poster_with_more_points():
    rng = np.random.default_rng(8)
    room, points, bearings = look(rng, 60)
    poster, shown, inside = look(rng, 120, offset=(9.0, 0.0, 0.0))
    inside *= 0.3  # as seen from there, in the middle of the image
    rays = np.column_stack([inside, np.ones(120)]) * rng.uniform(1.0, 4.0, (120, 1))
    shown = rays @ poster[:3, :3].T + poster[:3, 3]
    seen = np.concatenate([bearings, inside])
    features = Features(seen * CAMERA.fx + (CAMERA.cx, CAMERA.cy),
                        np.zeros((180, DIMENSIONS), np.uint8), np.ones(180, np.float32))
    matched = localization._Matched(np.arange(180), np.concatenate([points, shown]),
                                    np.repeat([0, 1], [60, 120]), np.arange(180))
    look_at = localization._Look(features, seen, CAMERA)
    first, second = localization._places(localization._place(matched, look_at), matched, look_at)
    assert pose_error(first.map_from_camera, room)[0] < 1e-3
    assert pose_error(second.map_from_camera, poster)[0] < 1e-3
    assert (first.agreed, second.agreed) == (60, 120)


def test_a_constraint_excludes_by_height_and_tilt_and_tells_how_far_the_vertical_is_off():
    def tilted(degrees, height=1.0):
        """Return the pose of a camera that looks along the map's x axis, and leans to the side."""
        level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
        return make_transform(level @ Rotation.from_euler('z', degrees, True).as_matrix(),
                              np.array([5.0, 6.0, height]))
    constraint = Constraint(min_height=0.5, max_height=1.5, max_tilt=np.radians(30.0))
    assert [constraint.allows(tilted(0.0, height)) for height in (0.4, 0.6, 1.4, 1.6)] == [
        False, True, True, False]
    assert [constraint.allows(tilted(angle)) for angle in (-31.0, 29.0, 180.0)] == [
        False, True, False]
    assert Constraint().allows(tilted(180.0, -9.0))
    covariance = np.diag([1.0, 1.0, 1.0, np.radians(4.0) ** 2, 1.0, 1.0])  # about the x axis
    assert constraint.tilt_error(tilted(20.0), covariance) == 0.0, 'unknown'
    known = constraint._replace(vertical_deviation=np.radians(3.0))
    assert known.tilt_error(tilted(20.0), covariance) == pytest.approx(4.0)
    assert known.tilt_error(tilted(-20.0), covariance) == pytest.approx(4.0)
    assert known.tilt_error(tilted(0.0), covariance) == pytest.approx(0.0)


MANY, WEAK = np.arange(40), np.tile(np.arange(LEAST_INLIERS - 2), 2)


def places_of(*rows):
    """Return the places of equal rooms, whose image shows some points each, and where [m]."""
    pose, points, bearings = look(np.random.default_rng(9), len(MANY))
    features = Features(bearings * CAMERA.fx + (CAMERA.cx, CAMERA.cy),
                        np.zeros((len(points), DIMENSIONS), np.uint8),
                        np.ones(len(points), np.float32))
    rooms = [points[some] + np.array([10.0 * number, 0.0, 0.0])
             for number, some in enumerate(rows)]
    counts = [len(some) for some in rows]
    matched = localization._Matched(np.concatenate(rows), np.concatenate(rooms),
                                    np.repeat(np.arange(len(rows)), counts),
                                    np.arange(sum(counts)))
    look_at = localization._Look(features, bearings, CAMERA)
    found = localization._places(localization._place(matched, look_at), matched, look_at)
    return found, sorted(np.round([one.map_from_camera[0, 3] - pose[0, 3] for one in found]))


def test_of_equal_rooms_each_is_a_place_of_its_own():
    found, at_m = places_of(MANY, MANY, MANY)
    assert at_m == [0.0, 10.0, 20.0]
    assert [one.agreed for one in found] == [40, 40, 40]
    most = localization.MOST_PLACES
    assert len(places_of(*[MANY] * (most + 2))[0]) == most


def test_few_features_are_a_place_where_there_is_no_other():
    """Those of two keyframes count once."""
    assert [one.agreed for one in places_of(WEAK)[0]] == [LEAST_INLIERS - 2]
    assert places_of(MANY, WEAK)[1] == [0.0]
    assert places_of(MANY, MANY[:LEAST_INLIERS + 2])[1] == [0.0, 10.0]


def test_rays_of_equal_features_meet_in_their_point():
    rng = np.random.default_rng(4)
    points = rng.uniform((-1, -1, 2), (1, 1, 4), (50, 3))
    descriptors = rng.integers(0, 255, (50, DIMENSIONS)).astype(np.uint8)
    images = []
    for x in (0.0, 0.3, 0.6):
        pose = make_transform(Rotation.from_rotvec([0.0, -0.1 * x, 0.0]).as_matrix(),
                              np.array([x, 0.0, 0.0]))
        inside = (points - pose[:3, 3]) @ pose[:3, :3]
        images.append(PosedFeatures(pose, inside[:, :2] / inside[:, 2:], descriptors))
    images[2].bearings[:5] += 0.1  # mismatched there, but not in the second image
    found = triangulate(images, 0)
    assert np.abs(found - points).max() < 1e-6


def test_without_parallax_there_are_no_points():
    rng = np.random.default_rng(5)
    descriptors = rng.integers(0, 255, (20, DIMENSIONS)).astype(np.uint8)
    bearings = rng.uniform(-0.4, 0.4, (20, 2))
    images = [PosedFeatures(make_transform(np.eye(3), np.array([x, 0.0, 0.0])), bearings,
                            descriptors) for x in (0.0, 0.1)]
    assert np.isnan(triangulate(images, 0)).all()
    assert np.isnan(triangulate(images[:1], 0)).all()


def test_features_are_found_in_any_image():
    rng = np.random.default_rng(6)
    texture = rng.integers(0, 255, (30, 40, 3)).astype(np.uint8).repeat(20, 0).repeat(20, 1)
    features = extract(texture, 300)
    assert 100 < len(features) <= 300
    assert (np.diff(features.strengths) <= 0).all()
    small = extract(texture[:400, :500], 300)
    pairs = match(unit_rows(small.descriptors), unit_rows(features.descriptors))
    shifts = features.pixels[pairs[:, 1]] - small.pixels[pairs[:, 0]]
    assert len(pairs) > 50
    assert np.mean(np.abs(shifts).max(axis=1) < 0.5) > 0.9
    for empty in (np.zeros((480, 640, 3), np.uint8), np.zeros((1, 1, 3), np.uint8),
                  np.full((1, 1, 3), 255, np.uint8), np.full((2, 3000, 3), 90, np.uint8)):
        assert len(extract(empty, 300)) == 0
