# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Embeddings of crops that have not changed since an earlier image: a standing robot's."""

from collections import deque
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.models.images import crop_bounds

# A box is the same if no edge has moved by more [px].
_MOVED_PX = 2.0
# Side of the small picture of a crop [px]. Its cells average out the noise of the sensor.
_SIDE = 8
# A crop is the same if its picture changed by less than this on average, and in its worst cell
# [grey levels]. Guesses: the demo's images with noise of 3 levels stay below, those of an object
# that is covered by a third do not.
_CHANGED, _CELL_CHANGED = 4.0, 32.0
# A crop costs 3.5 KB with an embedding of 768 numbers.
_LIMIT = 256


class _Known(NamedTuple):
    """A box (4,) [px], its small picture, and the embedding (d,) of its crop."""

    bbox_xyxy: NDArray[np.float64]
    picture: NDArray[np.int16]
    embedding: NDArray[np.float32]


class CropMemory:
    """The newest embeddings of one encoder, at most 256 of them."""

    def __init__(self) -> None:
        self._known: deque[_Known] = deque(maxlen=_LIMIT)

    def __len__(self) -> int:
        """Return the number of embeddings."""
        return len(self._known)

    def recall(self, image_rgb: NDArray[np.uint8], bboxes_xyxy: NDArray[np.float64]
               ) -> dict[int, NDArray[np.float32]]:
        """Return the embedding of each box, by its row, whose crop has not changed.

        A crop is compared with the one that was embedded, so slow changes do not add up.

        Parameters
        ----------
        image_rgb : ndarray (h, w, 3) uint8
        bboxes_xyxy : ndarray (n, 4)
            Each overlaps the image [px].
        """
        if not self._known:
            return {}
        pictures = _pictures(image_rgb, bboxes_xyxy)
        boxes = np.array([one.bbox_xyxy for one in self._known])
        found = {}
        for row, (bbox, picture) in enumerate(zip(bboxes_xyxy, pictures, strict=True)):
            near = np.nonzero(np.abs(boxes - bbox).max(axis=1) <= _MOVED_PX)[0]
            for candidate in reversed(near):
                if _is_same(picture, self._known[candidate].picture):
                    found[row] = self._known[candidate].embedding
                    break
        return found

    def keep(self, image_rgb: NDArray[np.uint8], bboxes_xyxy: NDArray[np.float64],
             embeddings: NDArray[np.float32]) -> None:
        """Remember the embeddings (n, d) of boxes (n, 4); the oldest ones are dropped."""
        self._known.extend(map(_Known, bboxes_xyxy, _pictures(image_rgb, bboxes_xyxy),
                               embeddings))


def _pictures(image_rgb: NDArray[np.uint8], bboxes_xyxy: NDArray[np.float64]
              ) -> list[NDArray[np.int16]]:
    """Return a small picture of each crop."""
    height, width = image_rgb.shape[:2]
    return [cv2.resize(image_rgb[top:bottom, left:right], (_SIDE, _SIDE),
                       interpolation=cv2.INTER_AREA).astype(np.int16)
            for left, top, right, bottom in crop_bounds(bboxes_xyxy, width, height).tolist()]


def _is_same(one: NDArray[np.int16], other: NDArray[np.int16]) -> bool:
    change = np.abs(one - other)
    return bool(change.mean() < _CHANGED and change.max() < _CELL_CHANGED)
