# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cliploc_ros.core.geometry.camera import Camera, frusta
from cliploc_ros.errors import CameraError

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
    # it would show these points in the middle of the image
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
