# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Check images, and compute the crops that an encoder sees."""

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import CliplocError, ImageError


def check_image_rgb(image_rgb: NDArray[np.uint8]) -> None:
    """Raise an ImageError unless the image is (h, w, 3) uint8 with at least one pixel."""
    if not isinstance(image_rgb, np.ndarray):
        raise ImageError(f'an image must be a NumPy array, not {type(image_rgb).__name__}')
    if image_rgb.ndim != 3 or image_rgb.shape[2] != 3 or image_rgb.dtype != np.uint8:
        raise ImageError(f'an image must have shape (h, w, 3) and type uint8, not '
                         f'{image_rgb.shape} and {image_rgb.dtype}')
    if image_rgb.size == 0:
        raise ImageError(f'the image has no pixels: its shape is {image_rgb.shape}')


def visible_boxes(bboxes_xyxy: NDArray[np.float64], width: int, height: int
                  ) -> NDArray[np.bool_]:
    """Return a mask (n,): the boxes (n, 4) left, top, right, bottom [px] that can be cropped.

    The other boxes are not finite, empty or inverted, or do not overlap the image.
    """
    bboxes_xyxy = _as_boxes(bboxes_xyxy)
    left, top, right, bottom = bboxes_xyxy.T
    with np.errstate(invalid='ignore'):
        overlaps = ((np.minimum(right, width) > np.maximum(left, 0.0))
                    & (np.minimum(bottom, height) > np.maximum(top, 0.0)))
    return np.isfinite(bboxes_xyxy).all(axis=1) & overlaps


def crop_bounds(bboxes_xyxy: NDArray[np.float64], width: int, height: int
                ) -> NDArray[np.int64]:
    """Return the pixels (n, 4) that boxes touch: left, top, and right, bottom (exclusive).

    The bounds are clipped to the image. Each crop has at least one pixel. CliplocError: a box
    cannot be cropped, see `visible_boxes`.
    """
    bboxes_xyxy = _as_boxes(bboxes_xyxy)
    hidden = np.flatnonzero(~visible_boxes(bboxes_xyxy, width, height))
    if len(hidden):
        raise CliplocError(f'box {hidden[0]}, {bboxes_xyxy[hidden[0]].tolist()}, cannot be '
                           f'cropped from an image of {width}x{height} px')
    size = np.array([width, height, width, height])
    clamped = np.clip(bboxes_xyxy, 0, size)
    return np.concatenate(
        [np.floor(clamped[:, :2]), np.ceil(clamped[:, 2:])], axis=1).astype(np.int64)


def _as_boxes(bboxes_xyxy: NDArray[np.float64]) -> NDArray[np.float64]:
    bboxes_xyxy = np.asarray(bboxes_xyxy, dtype=np.float64)
    if bboxes_xyxy.size == 0:
        return np.empty((0, 4))
    if bboxes_xyxy.ndim != 2 or bboxes_xyxy.shape[1] != 4:
        raise CliplocError(f'boxes must have shape (n, 4), not {bboxes_xyxy.shape}')
    return bboxes_xyxy
