# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which boxes can be cropped, and which pixels a crop holds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cliploc_ros.errors import CliplocError, ImageError
from cliploc_ros.models.images import check_image_rgb, crop_bounds, visible_boxes

nan, inf = float('nan'), float('inf')


@pytest.mark.parametrize(('bbox', 'visible', 'bounds'), [
    ([10.0, 20.0, 30.0, 40.0], True, [10, 20, 30, 40]),
    ([10.2, 20.8, 30.1, 40.9], True, [10, 20, 31, 41]),
    ([-50.0, -50.0, 1000.0, 1000.0], True, [0, 0, 64, 48]),
    ([63.5, 47.5, 1e300, 1e300], True, [63, 47, 64, 48]),
    ([64.0, 10.0, 80.0, 20.0], False, None), ([30.0, 10.0, 20.0, 20.0], False, None),
    ([nan, 10.0, 20.0, 20.0], False, None), ([0.0, 0.0, inf, 20.0], False, None)])
def test_box(bbox, visible, bounds):
    bboxes = np.array([bbox])
    assert visible_boxes(bboxes, 64, 48).tolist() == [visible]
    if visible:
        assert crop_bounds(bboxes, 64, 48).tolist() == [bounds]
    else:
        with pytest.raises(CliplocError, match=r'box 0, .*64x48'):
            crop_bounds(bboxes, 64, 48)


@given(st.lists(st.lists(st.floats(), min_size=4, max_size=4), max_size=8),
       st.integers(1, 50), st.integers(1, 50))
def test_every_visible_box_has_pixels(boxes, width, height):
    bboxes = np.array(boxes).reshape(-1, 4)
    kept = bboxes[visible_boxes(bboxes, width, height)]
    left, top, right, bottom = crop_bounds(kept, width, height).T
    assert ((left >= 0) & (left < right) & (right <= width)).all()
    assert ((top >= 0) & (top < bottom) & (bottom <= height)).all()


@pytest.mark.parametrize(('image', 'message'), [
    (np.zeros((0, 0, 3), np.uint8), 'no pixels'), (np.zeros((4, 4), np.uint8), r'\(4, 4\)'),
    (np.zeros((4, 4, 3), np.float32), 'float32')])
def test_no_image(image, message):
    with pytest.raises(ImageError, match=message):
        check_image_rgb(image)
