# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import (
    ellipse_bboxes,
    ellipses_in_pixels,
    project_ellipsoids,
    shape_matrices,
)
from cliploc_ros.core.geometry.transforms import invert_transform

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
