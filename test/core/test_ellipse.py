# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cliploc_ros.core.geometry.ellipse import ellipse_iou, unit_circle_overlap
from cliploc_ros.core.geometry.minimal_solvers import largest_cubic_root

sizes = st.floats(0.05, 20.0)
offsets = st.one_of(st.just(0.0), st.floats(-3.0, 3.0))


def iou_by_chords(half_width, half_height, center, shape, chords=20001):
    """The same IoU from the lengths of many vertical chords; the first ellipse at the origin."""
    reach = np.sqrt(shape[0, 0])
    low, high = max(-half_width, center[0] - reach), min(half_width, center[0] + reach)
    if low >= high:
        return 0.0
    # nodes crowd at both ends, where chords shrink like a square root
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
