# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compute the crops that an encoder sees."""

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import CliplocError


def crop_bounds(bboxes_xyxy: NDArray[np.float64], width: int, height: int
                ) -> NDArray[np.int64]:
    """Return the pixels (n, 4) that boxes touch: left, top, and right, bottom (exclusive).

    The bounds are clipped to the image. Each crop has at least one pixel. CliplocError: a box
    (n, 4), left, top, right, bottom [px], is not finite, empty or inverted, or does not overlap
    the image.
    """
    bboxes_xyxy = np.asarray(bboxes_xyxy, dtype=np.float64).reshape(-1, 4)
    left, top, right, bottom = bboxes_xyxy.T
    with np.errstate(invalid='ignore'):
        overlaps = ((np.minimum(right, width) > np.maximum(left, 0.0))
                    & (np.minimum(bottom, height) > np.maximum(top, 0.0)))
    hidden = np.flatnonzero(~(np.isfinite(bboxes_xyxy).all(axis=1) & overlaps))
    if len(hidden):
        raise CliplocError(f'box {hidden[0]}, {bboxes_xyxy[hidden[0]].tolist()}, cannot be '
                           f'cropped from an image of {width}x{height} px')
    clamped = np.clip(bboxes_xyxy, 0, np.array([width, height, width, height]))
    return np.concatenate(
        [np.floor(clamped[:, :2]), np.ceil(clamped[:, 2:])], axis=1).astype(np.int64)
