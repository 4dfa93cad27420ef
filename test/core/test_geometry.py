# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cameras, ellipses, ellipsoids, poses and their solvers: exact cases and properties."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from reference import nearest, solve_p3p
from scene import unit_rows
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.camera_faults import camera_faults, fields_of_view
from cliploc_ros.core.geometry.ellipse import ellipse_iou, unit_circle_overlap
from cliploc_ros.core.geometry.ellipsoid import ellipse_bboxes, project_ellipsoids, shape_matrices
from cliploc_ros.core.geometry.minimal_solvers import two_point
from cliploc_ros.core.geometry.transforms import move_covariance
from cliploc_ros.errors import CameraError

LENSES = {
    'none': ('', ()),
    'freiburg1': ('plumb_bob', (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    'barrel': ('plumb_bob', (-0.35, 0.12, 0.001, -0.001, 0.0)),
    'rational': ('rational_polynomial', (1.0, 0.2, 0.001, -0.0005, 0.01, 1.3, 0.5, 0.05)),
    'fisheye': ('equidistant', (-0.02, 0.01, -0.005, 0.001)),
    'weak': ('plumb_bob', (-1.0, 0.0, 0.0, 0.0)), 'strong': ('plumb_bob', (-6.0, 0.0, 0.0, 0.0))}

SOUND = {'width': 640, 'height': 480, 'fx': 525.0, 'fy': 525.0, 'cx': 320.0, 'cy': 240.0}


def camera(lens, focal=400.0):
    return Camera(640, 480, focal, focal + 1, 318.6, 255.3, *LENSES[lens])


@pytest.mark.parametrize('lens', ['none', 'freiburg1', 'barrel', 'rational', 'fisheye'])
@given(st.floats(0, 640), st.floats(0, 480))
def test_normalizing_inverts_projecting(lens, u, v):
    normalized = camera(lens).normalize_points(np.array([[u, v]]))
    assert camera(lens).project_normalized(normalized) == pytest.approx(np.array([[u, v]]))


def test_beyond_the_fold_of_a_lens_is_nan():
    folded = Camera(640, 480, 500.0, 500.0, 320.0, 240.0, 'plumb_bob', (-2.0, 0.0, 0.0, 0.0))
    assert np.isnan(folded.normalize_points(np.array([[0.0, 0.0]]))).all()
    assert np.isfinite(folded.normalize_points(np.array([[300.0, 200.0]]))).all()
    # otherwise these points would be in the middle of the image
    sides = np.array([[0.69, 0.0], [0.0, -0.7], [0.2, 0.2]])
    assert np.isnan(folded.project_normalized(sides)).all(axis=1).tolist() == [True, True, False]


@pytest.mark.parametrize(('changes', 'message'), [
    ({'fx': 0.0}, 'positive'), ({'fy': float('nan')}, 'plausible'), ({'width': 0}, '0x480'),
    ({'distortion_model': 'mystery', 'distortion': (0.1,)}, "'mystery'"),
    ({'distortion_model': 'plumb_bob', 'distortion': (0.1,)}, '4 or 5'),
    ({'distortion_model': 'plumb_bob', 'distortion': (float('inf'),)}, 'not finite'),
])
def test_impossible_cameras_are_refused(changes, message):
    with pytest.raises(CameraError, match=message):
        Camera(**(SOUND | changes))


@pytest.mark.parametrize(('verdict', 'changes'), [
    (verdict, changes) for verdict, some in yaml.safe_load(
        Path(__file__).with_name('camera_faults.yaml').read_text()).items() for changes in some])
def test_cameras_that_no_image_has(verdict, changes):
    given = SOUND | changes
    lens = LENSES[given.pop('lens', 'none')]
    faults = camera_faults(Camera(**given, distortion_model=lens[0], distortion=lens[1]))
    assert verdict == ('sound' if not faults else 'refused' if faults[0].is_certain else 'doubted')


def test_the_field_of_view_is_that_of_the_lens():
    for lens, angles in (('none', (90.0, 90.0)), ('fisheye', np.degrees((2.0, 2.0)))):
        found = fields_of_view(Camera(640, 480, 320.0, 240.0, 320.0, 240.0, *LENSES[lens]))
        assert found == pytest.approx(angles)


sizes = st.floats(0.05, 20.0)
offsets = st.one_of(st.just(0.0), st.floats(-3.0, 3.0))


def iou_by_chords(half_width, half_height, center, shape, chords=20001):
    """Return the IoU from the lengths of many vertical chords, with one ellipse at the origin."""
    reach = np.sqrt(shape[0, 0])
    low, high = max(-half_width, center[0] - reach), min(half_width, center[0] + reach)
    if low >= high:
        return 0.0
    # nodes are dense at both ends, where chords shrink like a square root
    angles = (np.arange(chords) + 0.5) / chords * np.pi
    x = (low + high) / 2 - (high - low) / 2 * np.cos(angles)
    weights = (high - low) / 2 * np.sin(angles) * np.pi / chords
    half_a = half_height * np.sqrt(np.maximum(0, 1 - (x / half_width)**2))
    middle = center[1] + shape[0, 1] / shape[0, 0] * (x - center[0])
    half_b = np.sqrt(np.maximum(0, (shape[1, 1] - shape[0, 1]**2 / shape[0, 0])
                                * (1 - (x - center[0])**2 / shape[0, 0])))
    chord = np.minimum(half_a, middle + half_b) - np.maximum(-half_a, middle - half_b)
    shared = (np.maximum(0, chord) * weights).sum()
    areas = np.pi * half_width * half_height + np.pi * np.sqrt(np.linalg.det(shape))
    return shared / (areas - shared)


def turned(p, q, angle):
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return rotation @ np.diag([p * p, q * q]) @ rotation.T


@given(sizes, sizes, sizes, sizes, offsets, offsets, st.floats(0.0, np.pi))
def test_iou_equals_quadrature(a, b, p, q, x, y, angle):
    shape = turned(p, q, angle)
    iou = ellipse_iou(0.0, 0.0, a, b, x, y, shape[0, 0], shape[0, 1], shape[1, 1])
    assert iou == pytest.approx(iou_by_chords(a, b, (x, y), shape), abs=1e-5)


@pytest.mark.parametrize(('center', 'axes', 'shared'), [
    ((0.0, 0.0), (1.0, 1.0), np.pi),             # equal circles
    ((1.0, 0.0), (1.0, 1.0), 2 * np.pi / 3 - np.sqrt(3) / 2),  # two circles at distance one
    ((0.0, 0.0), (1.0, 0.2), 0.2 * np.pi),       # inside, touching at both ends
    ((0.4, 0.0), (0.6, 0.3), 0.18 * np.pi),      # inside, touching once
])
def test_shared_area_of_simple_cases(center, axes, shared):
    assert unit_circle_overlap(*center, *axes) == pytest.approx(shared, abs=1e-7)


axes = st.floats(0.01, 0.6)


@given(st.tuples(axes, axes, axes), st.tuples(*[st.floats(-1, 1)] * 4),
       st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(1.0, 8.0)))
def test_outline_touches_dense_surface_samples(semi_axes, quaternion, center):
    quat_xyzw = np.add(quaternion, [0.0, 0.0, 0.0, 1.5])
    quat_xyzw /= np.linalg.norm(quat_xyzw)
    around, along = np.meshgrid(np.linspace(0, 2 * np.pi, 400), np.linspace(0, np.pi, 200))
    sphere = np.stack([np.cos(around) * np.sin(along), np.sin(around) * np.sin(along),
                       np.cos(along)], axis=-1).reshape(-1, 3)
    surface = Rotation.from_quat(quat_xyzw).apply(sphere * semi_axes) + center
    seen = surface[:, :2] / surface[:, 2:]
    box = ellipse_bboxes(project_ellipsoids(
        np.eye(4), np.array([center]), shape_matrices(np.array([semi_axes]), quat_xyzw[None])))[0]
    size = (box[2:] - box[:2]).max()
    assert np.abs(seen.min(axis=0) - box[:2]).max() < 2e-3 * size
    assert np.abs(seen.max(axis=0) - box[2:]).max() < 2e-3 * size
    assert (seen >= box[:2] - 1e-9).all() and (seen <= box[2:] + 1e-9).all()


@pytest.mark.parametrize('depth', [-3.0, 0.0, 0.2, 0.3])
def test_not_wholly_in_front_has_no_outline(depth):
    shapes = shape_matrices(np.full((1, 3), 0.3), np.array([[0.0, 0.0, 0.0, 1.0]]))
    assert np.isnan(project_ellipsoids(np.eye(4), np.array([[0.0, 0.0, depth]]), shapes)).all()


def test_moving_a_covariance_by_a_lever(rng):
    """The covariance about the moved origin equals that of moved samples."""
    spread = np.diag([0.01, 0.02, 0.03, 0.001, 0.002, 0.003])
    lever = np.array([0.5, -1.0, 0.2])
    samples = rng.multivariate_normal(np.zeros(6), spread, 200_000)
    moved = samples.copy()
    moved[:, :3] += np.cross(samples[:, 3:], lever)
    assert move_covariance(spread, lever) == pytest.approx(np.cov(moved.T), abs=3e-4)


def test_pixels_of_a_fisheye_are_rays_up_to_88_degrees_and_none_behind():
    angles = np.radians([1.0, 45.0, 80.0, 88.0, 91.0, 110.0])
    wide = Camera(1000, 1000, 200.0, 200.0, 500.0, 500.0, 'equidistant', (0.0,) * 4)
    for turn in np.radians([0.0, 37.0, 90.0, 200.0]):
        direction = np.array([np.cos(turn), np.sin(turn)])
        points = wide.normalize_points(500.0 + 200.0 * angles[:, None] * direction)
        np.testing.assert_allclose(points[:4], np.tan(angles[:4])[:, None] * direction, rtol=1e-4,
                                   atol=1e-9)
        assert np.isnan(points[4:]).all()
        np.testing.assert_allclose(wide.project_normalized(points[:4]),
                                   500.0 + 200.0 * angles[:4, None] * direction, atol=0.1)


def test_boxes_far_from_the_axis_of_a_fisheye_have_no_use():
    wide = Camera(1000, 1000, 200.0, 200.0, 500.0, 500.0, 'equidistant', (0.0,) * 4)
    at = 500.0 + 200.0 * np.radians([20.0, 60.0, 74.0, 76.0, 95.0])
    boxes = np.array([[at[0], 490, at[1], 510], [at[0], 490, at[2], 510],
                      [at[0], 490, at[3], 510], [at[2], 490, at[4], 510]])
    assert np.isfinite(wide.normalize_bboxes(boxes)).all(axis=1).tolist() == [
        True, True, False, False]
    straight = Camera(1000, 1000, 100.0, 100.0, 500.0, 500.0)
    assert np.isfinite(straight.normalize_bboxes(boxes)).all()


def random_problem(rng, count=3):
    """Return points at random bearings and depths in front of a camera at a random pose."""
    seen = rng.uniform(-1, 1, (count, 3))
    seen[:, 2] = rng.uniform(0.5, 6.0, count)
    seen[:, :2] *= seen[:, 2:]
    rotation = Rotation.from_rotvec(rng.normal(size=3) * 2).as_matrix()
    translation = rng.normal(size=3) * 2
    return seen, (seen - translation) @ rotation, rotation, translation


def solve(bearings, points, up_in_camera, up_in_map):
    """Return the rotations (s, 3, 3) and translations (s, 3) from three points or from two."""
    if len(points) == 3:
        return solve_p3p(bearings, points)
    rotations, translations = np.empty((2, 3, 3)), np.empty((2, 3))
    count = two_point(np.ascontiguousarray(bearings), np.ascontiguousarray(points),
                      np.concatenate([up_in_camera, up_in_map]), rotations, translations)
    return rotations[:count], translations[:count]


@pytest.mark.parametrize('count', [3, 2])
def test_p3p_and_two_points_recover_random_poses_and_find_solutions_only_none_twice(count, rng):
    worst, several = 0.0, 0
    for number in range(10_000):
        seen, points, rotation, translation = random_problem(rng, count)
        up_in_map, bearings = unit_rows(rng.normal(size=(1, 3)))[0], unit_rows(seen)
        rotations, translations = solve(bearings, points, rotation @ up_in_map, up_in_map)
        worst = max(worst, nearest(rotations, translations, rotation, translation))
        several += len(rotations) > 1
        for index, found in enumerate(rotations if number < 2_000 else ()):
            assert np.abs(found @ found.T - np.eye(3)).max() < 1e-8
            assert np.linalg.det(found) > 0
            again = unit_rows(points @ found.T + translations[index])
            assert np.abs(again - bearings).max() < 1e-7
            assert nearest(rotations[:index], translations[:index], found,
                           translations[index]) > 1e-9
            assert count == 3 or np.abs(found @ up_in_map - rotation @ up_in_map).max() < 1e-12
    print(f'\n10,000 random poses recovered to {worst:.1e}')
    assert worst < 1e-8
    assert several > 500


@pytest.mark.parametrize('points', [
    np.zeros((3, 3)),
    np.array([[0.0, 0, 5], [0, 0, 5], [1, 0, 5]]),
    np.array([[0.0, 0, 5], [1, 0, 5], [2, 0, 5]]),
    np.full((3, 3), np.nan),
    np.zeros((2, 3)),                              # one point
    np.array([[0.0, 0, 1], [0, 0, 2]]),            # one above the other
    np.full((2, 3), np.nan),
])
def test_degenerate_points_have_no_pose(points):
    bearings = unit_rows(np.array([[0.0, 0, 1], [0.2, 0.1, 1], [0.4, 0.2, 1]]))[:len(points)]
    assert len(solve(bearings, points, np.array([0.0, -1.0, 0.0]),
                     np.array([0.0, 0.0, 1.0]))[0]) == 0
