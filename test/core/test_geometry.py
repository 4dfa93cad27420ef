# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cameras, ellipses, ellipsoids and poses: exact cases, properties, and a room in fisheyes."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera, frusta
from cliploc_ros.core.geometry.camera_faults import camera_faults, fields_of_view
from cliploc_ros.core.geometry.ellipse import ellipse_iou, unit_circle_overlap
from cliploc_ros.core.geometry.ellipsoid import (
    ellipse_bboxes,
    ellipses_in_pixels,
    project_ellipsoids,
    shape_matrices,
)
from cliploc_ros.core.geometry.minimal_solvers import largest_cubic_root
from cliploc_ros.core.geometry.transforms import (
    invert_transform,
    make_transform,
    move_covariance,
    pose_error,
    quaternion_from_transform,
    rotation_angle_deg,
    transform_from_pose,
)
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import CameraError
from cliploc_ros.offline.datasets.intrinsics import PRESETS, read_camera

LENSES = {
    'none': ('', ()),
    'freiburg1': ('plumb_bob', (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    'barrel': ('plumb_bob', (-0.35, 0.12, 0.001, -0.001, 0.0)),
    'rational': ('rational_polynomial', (1.0, 0.2, 0.001, -0.0005, 0.01, 1.3, 0.5, 0.05)),
    'fisheye': ('equidistant', (-0.02, 0.01, -0.005, 0.001)),
}


def camera(lens, focal=400.0):
    return Camera(640, 480, focal, focal + 1, 318.6, 255.3, *LENSES[lens])


@pytest.mark.parametrize('lens', LENSES)
@given(st.floats(0, 640), st.floats(0, 480))
def test_normalizing_inverts_projecting(lens, u, v):
    normalized = camera(lens).normalize_points(np.array([[u, v]]))
    assert camera(lens).project_normalized(normalized) == pytest.approx(np.array([[u, v]]))


def test_plumb_bob_equals_its_equation():
    k1, k2, p1, p2, k3 = LENSES['freiburg1'][1]
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    expected = (400 * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + 318.6,
                401 * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + 255.3)
    assert camera('freiburg1').project_normalized(np.array([[x, y]]))[0] == pytest.approx(expected)


def test_beyond_the_fold_of_a_lens_is_nan():
    folded = Camera(640, 480, 500.0, 500.0, 320.0, 240.0, 'plumb_bob', (-2.0, 0.0, 0.0, 0.0))
    assert np.isnan(folded.normalize_points(np.array([[0.0, 0.0]]))).all()
    assert np.isfinite(folded.normalize_points(np.array([[300.0, 200.0]]))).all()
    # otherwise these points would be in the middle of the image
    sides = np.array([[0.69, 0.0], [0.0, -0.7], [0.2, 0.2]])
    assert np.isnan(folded.project_normalized(sides)).all(axis=1).tolist() == [True, True, False]


def test_boxes_of_the_plane_come_back_as_pixels():
    boxes = np.array([[100.0, 50.0, 300.0, 250.0], [0.0, 10.0, 20.0, 40.0]])
    edges = camera('none').normalize_bboxes(boxes)
    np.testing.assert_allclose(edges[0], [
        (100 - 318.6) / 400, (50 - 255.3) / 401, (300 - 318.6) / 400, (250 - 255.3) / 401])
    np.testing.assert_allclose(camera('none').bboxes_in_pixels(edges), boxes, atol=1e-9)


@pytest.mark.parametrize(('changes', 'message'), [
    ({'fx': 0.0}, 'positive'), ({'fy': float('nan')}, 'finite'), ({'width': 0}, '0x480'),
    ({'distortion_model': 'mystery', 'distortion': (0.1,)}, "'mystery'"),
    ({'distortion_model': 'plumb_bob', 'distortion': (0.1,)}, '4 or 5'),
    ({'distortion_model': 'plumb_bob', 'distortion': (float('inf'),)}, 'not finite'),
])
def test_impossible_cameras_are_refused(changes, message):
    sound = {'width': 640, 'height': 480, 'fx': 500.0, 'fy': 500.0, 'cx': 320.0, 'cy': 240.0}
    with pytest.raises(CameraError, match=message):
        Camera(**(sound | changes))


def test_a_frustum_ends_at_the_borders_of_the_image():
    one = Camera(640, 480, 400.0, 300.0, 320.0, 240.0)
    base = frusta([one], np.eye(4)[None], 2.0)[:4, 1]
    np.testing.assert_allclose(np.abs(base), np.tile([1.6, 1.6, 2.0], (4, 1)))


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
    """Valid cameras: 10 % off the middle, fx and fy 3 % apart, portrait, thermal, fisheyes."""
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
    # coefficients of another lens, or in another order
    ({'distortion_model': 'plumb_bob', 'distortion': (-6.0, 0.0, 0.0, 0.0)}, 'refused'),
    ({'distortion_model': 'plumb_bob', 'distortion': (-1.0, 0.0, 0.0, 0.0)}, 'doubted')])
def test_cameras_that_no_image_has(changes, verdict):
    assert judged(changes) == verdict


def test_recorded_cameras_are_sound(shared_data):
    cameras = [*PRESETS.values(), *map(read_camera, shared_data.glob('**/camera.json'))]
    assert len(cameras) >= 7
    assert [camera_faults(camera) for camera in cameras] == [()] * len(cameras)


def test_the_field_of_view_is_that_of_the_lens():
    lens = SOUND | {'fx': 320.0, 'fy': 240.0}
    assert fields_of_view(Camera(**lens)) == pytest.approx((90.0, 90.0))
    assert fields_of_view(Camera(**lens, **FISHEYE)) == pytest.approx(np.degrees((2.0, 2.0)))


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
    ((0.0, 0.0), (0.5, 0.25), np.pi / 8),        # inside
    ((0.0, 0.0), (3.0, 2.0), np.pi),             # around
    ((5.0, 0.0), (1.0, 0.5), 0.0),               # apart
    ((1.0, 0.0), (1.0, 1.0), 2 * np.pi / 3 - np.sqrt(3) / 2),  # two circles at distance one
    ((0.0, 0.0), (2.0, 0.5), None),              # a cross: four common points
    ((0.0, 0.0), (1.0, 0.2), 0.2 * np.pi),       # inside, touching at both ends
    ((0.0, 0.0), (3.0, 1.0), np.pi),             # around, touching at both sides
    ((0.4, 0.0), (0.6, 0.3), 0.18 * np.pi),      # inside, touching once
    ((2.0, 0.0), (1.0, 0.5), 0.0),               # apart, touching once
])
def test_shared_area_of_simple_cases(center, axes, shared):
    if shared is None:
        shared = iou_by_chords(1.0, 1.0, center, np.diag(np.square(axes)))
        shared = shared / (1 + shared) * 2 * np.pi
    assert unit_circle_overlap(*center, *axes) == pytest.approx(shared, abs=1e-7)


@given(st.lists(st.floats(-10.0, 10.0), min_size=3, max_size=3))
def test_largest_cubic_root(roots):
    c2, c1, c0 = np.poly(roots)[1:]
    # a double root is only as precise as the square root of the coefficients' precision
    assert largest_cubic_root(c2, c1, c0) == pytest.approx(max(roots), abs=1e-4)


axes = st.floats(0.01, 0.6)


def box_iou(a, b):
    overlap = np.prod(np.maximum(0.0, np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])))
    return overlap / (np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - overlap)


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
    assert (seen >= box[:2] - 1e-9).all()
    assert (seen <= box[2:] + 1e-9).all()


@pytest.mark.parametrize('depth', [-3.0, 0.0, 0.2, 0.3])
def test_not_wholly_in_front_has_no_outline(depth):
    shapes = shape_matrices(np.full((1, 3), 0.3), np.array([[0.0, 0.0, 0.0, 1.0]]))
    assert np.isnan(project_ellipsoids(np.eye(4), np.array([[0.0, 0.0, depth]]), shapes)).all()


def test_sphere_ahead_is_a_known_circle():
    shapes = shape_matrices(np.full((1, 3), 0.6), np.array([[0.0, 0.0, 0.0, 1.0]]))
    outline = project_ellipsoids(np.eye(4), np.array([[0.0, 0.0, 1.0]]), shapes)[0]
    # the tangent cone of a sphere of radius 0.6 at distance 1: tan = 0.6 / 0.8
    assert outline == pytest.approx([0.0, 0.0, 0.75**2, 0.0, 0.75**2])


def test_outlines_equal_those_of_another_program(shared_data):
    recorded = json.loads((shared_data / 'projection/ellipsoid_projections.json').read_text())
    ids = list(recorded['landmarks'])
    landmarks = [recorded['landmarks'][landmark_id] for landmark_id in ids]
    matrix = np.array(recorded['K'])
    camera = Camera(640, 480, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    centers = np.array([landmark['center'] for landmark in landmarks])
    shapes = shape_matrices(
        np.array([landmark['radii'] for landmark in landmarks]),
        np.array([np.roll(landmark['quat_wxyz'], -1) for landmark in landmarks]))
    worst_px, worst_iou, count = 0.0, 0.0, 0
    for frame in recorded['frames']:
        camera_from_map = invert_transform(np.array(frame['map_from_camera']))
        outlines = ellipses_in_pixels(project_ellipsoids(camera_from_map, centers, shapes),
                                      camera)
        boxes = ellipse_bboxes(outlines)
        for box in frame['boxes']:
            projected = boxes[ids.index(str(box['landmark']))]
            detected = np.array(box['detected_bbox_xyxy'])
            theirs = np.array(box['projected_bbox_xyxy'])
            worst_px = max(worst_px, np.abs(projected - theirs).max())
            worst_iou = max(worst_iou, abs(box_iou(theirs, detected) - box['iou']))
            count += 1
    print(f'\n{count} boxes: at most {worst_px:.4f} px and {worst_iou:.1e} IoU off')
    assert count == 1900
    assert worst_px < 0.05
    assert worst_iou < 1e-6


numbers = st.floats(-3.0, 3.0)
transforms = st.builds(
    lambda position, turn: transform_from_pose(np.array(position),
                                               Rotation.from_rotvec(turn).as_quat()),
    st.tuples(numbers, numbers, numbers), st.tuples(numbers, numbers, numbers))


@given(transforms)
def test_inverse(a_from_b):
    assert a_from_b @ invert_transform(a_from_b) == pytest.approx(np.eye(4), abs=1e-12)


@given(transforms)
def test_quaternion_and_back(a_from_b):
    quat_xyzw = quaternion_from_transform(a_from_b)
    assert quat_xyzw[3] >= 0
    assert transform_from_pose(a_from_b[:3, 3], quat_xyzw) == pytest.approx(a_from_b, abs=1e-9)


def test_a_quarter_turn_about_z():
    turn = transform_from_pose(np.array([1.0, 2.0, 3.0]), np.array([0, 0, 0.5**0.5, 0.5**0.5]))
    assert turn @ (1.0, 0.0, 0.0, 1.0) == pytest.approx([1.0, 3.0, 3.0, 1.0])
    assert rotation_angle_deg(turn[:3, :3]) == pytest.approx(90.0)
    assert pose_error(turn, np.eye(4)) == pytest.approx((14**0.5, 90.0))


def test_moving_a_covariance_by_a_lever(rng):
    """The covariance about the moved origin equals that of moved samples."""
    spread = np.diag([0.01, 0.02, 0.03, 0.001, 0.002, 0.003])
    lever = np.array([0.5, -1.0, 0.2])
    samples = rng.multivariate_normal(np.zeros(6), spread, 200_000)
    moved = samples.copy()
    moved[:, :3] += np.cross(samples[:, 3:], lever)
    assert move_covariance(spread, lever) == pytest.approx(np.cov(moved.T), abs=3e-4)


SIZE = np.array([640, 480])
REQUESTS = 10


@pytest.fixture(scope='module')
def room():
    """Return twenty-four upright objects of ten classes in a room of 6 x 5 m."""
    rng, count = np.random.default_rng(1), 24
    quats = Rotation.from_euler('z', rng.uniform(0, 360, (count, 1)), degrees=True).as_quat()
    return LandmarkMap(
        'map', tuple(f'thing {i}' for i in range(count)),
        tuple(f'label {i}' for i in range(count)),
        tuple('abcdefghij'[i % 10] for i in range(count)),
        rng.uniform((0, 0, 0.2), (6, 5, 1.8), (count, 3)), rng.uniform(0.06, 0.35, (count, 3)),
        quats)


def surfaces(room):
    """Return points (L, 2000, 3) on the ellipsoids, on a spiral over each."""
    steps = np.arange(2000)
    z = 1.0 - (2 * steps + 1) / 2000
    turn = steps * np.pi * (3 - np.sqrt(5))
    sphere = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], 1)
    return np.array([Rotation.from_quat(quat).apply(sphere * axes) + center for center, axes, quat
                     in zip(room.centers, room.semi_axes, room.quats_xyzw, strict=True)])


def fisheye_pixels(points, focal_px, d):
    """OpenCV's equation: the radius is a polynomial of the angle to the axis."""
    across = np.linalg.norm(points[..., :2], axis=-1)
    angle = np.arctan2(across, points[..., 2])
    radius = angle * (1 + sum(one * angle**(2 * n) for n, one in enumerate(d, start=1)))
    return focal_px * points[..., :2] * (radius / across)[..., None] + SIZE / 2


def looks(room, focal_px, d, rng):
    """Yield requests from random places: a pose, and the boxes of visible objects."""
    points = surfaces(room)
    for _ in range(REQUESTS):
        axes = Rotation.from_euler('ZXZ', rng.normal((0, -90, 0), (120, 8, 4)), degrees=True)
        pose = make_transform(axes.as_matrix(), rng.uniform((1, 1, 0.5), (5, 4, 1.2)))
        inside = (points - pose[:3, 3]) @ pose[:3, :3]
        pixels = fisheye_pixels(inside, focal_px, d)
        boxes = np.concatenate([pixels.min(axis=1), pixels.max(axis=1)], axis=1)
        cut = np.clip(boxes, 0, np.tile(SIZE, 2))
        shown = (cut[:, 2:] - cut[:, :2]).prod(axis=1) > 0.7 * (boxes[:, 2:] - boxes[:, :2]).prod(
            axis=1)
        rows = np.nonzero(shown & (np.linalg.norm(inside, axis=2).min(axis=1) > 0.2)
                          & ((cut[:, 2:] - cut[:, :2]).min(axis=1) > 8))[0]
        noisy = np.clip(cut[rows] + rng.normal(0, 1, (len(rows), 4)), 0, np.tile(SIZE, 2))
        yield pose, Detections(noisy, tuple(room.class_ids[row] for row in rows),
                               np.full(len(rows), 0.8))


@pytest.mark.parametrize(('wide_deg', 'd'), [
    (120.0, (0.0,) * 4), (190.0, (0.0,) * 4), (150.0, (-0.02, 0.01, -0.005, 0.001))])
def test_poses_of_a_fisheye_are_right(room, wide_deg, d):
    """With a pinhole model, 10 of 10 images of an ideal fisheye were accepted .2 to .5 m off."""
    focal_px = SIZE[0] / np.radians(wide_deg)
    camera = Camera(*SIZE.tolist(), focal_px, focal_px, *(SIZE / 2), 'equidistant', d)
    relocalizer = Relocalizer(room, RelocalizerOptions(matching='class'))
    found = [(relocalizer.relocalize([Observation(camera, detections)]), pose)
             for pose, detections in looks(room, focal_px, d, np.random.default_rng(2))]
    accepted = [pose_error(one.map_from_camera, pose) for one, pose in found if one.accepted]
    assert len(accepted) >= 8
    assert max(distance_m for distance_m, _ in accepted) < 0.12
    assert max(angle_deg for _, angle_deg in accepted) < 3.0


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
