# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compare the crops of an image with labels."""

import time
from collections import deque
from collections.abc import Mapping
from copy import copy
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.similarities import CropSimilarities, LabelEmbeddings
from cliploc_ros.errors import CliplocError
from cliploc_ros.models.protocols import ImageTextEncoder

# A box is unchanged if no edge has moved by more [px].
_MOVED_PX = 2.0
# Side of the thumbnail of a crop [px]. Its cells average out the noise of the sensor.
_SIDE = 8
# A crop is unchanged if its thumbnail changed by less than this on average, and in its worst cell
# [grey levels]. Images of the demo with noise of 3 levels stay below these limits; those of an
# object a third of which is covered exceed them. Not measured on robots.
_CHANGED, _CELL_CHANGED = 4.0, 32.0
# Each crop takes 3.5 KB with an embedding of 768 numbers.
_LIMIT = 256
# If no crop fits the time left, the estimated time of a crop decays by this factor, so that CLIP
# is tried again after a moment of high load. Not measured.
_FADING = 0.9
# The next batch may take this much longer than the newest one. Not measured.
_SLOWER = 1.3
# Greatest number of crops between two checks of the clock.
_MOST_CROPS = 64


def crop_bounds(bboxes_xyxy: NDArray[np.float64], width: int, height: int) -> NDArray[np.int64]:
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


class _Known(NamedTuple):
    """A box (4,) [px], its thumbnail, and the embedding (d,) of its crop."""

    bbox_xyxy: NDArray[np.float64]
    picture: NDArray[np.int16]
    embedding: NDArray[np.float32]


def _pictures(image_rgb: NDArray[np.uint8], bboxes_xyxy: NDArray[np.float64]
              ) -> list[NDArray[np.int16]]:
    """Return a thumbnail of each crop."""
    height, width = image_rgb.shape[:2]
    return [cv2.resize(image_rgb[top:bottom, left:right], (_SIDE, _SIDE),
                       interpolation=cv2.INTER_AREA).astype(np.int16)
            for left, top, right, bottom in crop_bounds(bboxes_xyxy, width, height).tolist()]


class Observer:
    """Encodes the crops of an image and compares them with the labels of a map's landmarks."""

    def __init__(self, encoder: ImageTextEncoder,
                 label_embeddings: LabelEmbeddings | NDArray[np.float32]) -> None:
        self._encoder = encoder
        self._labels = LabelEmbeddings.of(label_embeddings)
        self._known: deque[_Known] = deque(maxlen=_LIMIT)  # the newest embeddings
        self._crop_s: float | None = None

    def with_labels(self, label_embeddings: LabelEmbeddings) -> 'Observer':
        """Return an observer with the same encoder for the labels of another map."""
        observer = copy(self)
        observer._labels = label_embeddings
        return observer

    def measure(self) -> None:
        """Encode one crop, so that the first request knows how long a crop takes."""
        self._encode(np.zeros((32, 32, 3), dtype=np.uint8), np.array([[0.0, 0.0, 32.0, 32.0]]))

    def crops_within(self, left_s: float) -> int:
        """Estimate the number of crops that fit a time [s], from the time of the newest batch."""
        if self._crop_s is None:
            return 1
        count = int(np.clip(left_s / max(_SLOWER * self._crop_s, 1e-6), 0, _MOST_CROPS))
        if count < 1:
            self._crop_s *= _FADING
        return max(0, count)

    def crops(self, image_rgb: NDArray[np.uint8], bboxes_xyxy: NDArray[np.float64],
              known: Mapping[int, NDArray[np.float32]] | None = None) -> 'ObservedCrops':
        """Return the crops of an image (h, w, 3) uint8 at boxes (n, 4) [px].

        `known` has known embeddings (d,) by row; default: those of crops that have not changed
        since an earlier image.
        """
        return ObservedCrops(self, image_rgb, bboxes_xyxy, self._unchanged(
            image_rgb, bboxes_xyxy) if known is None else known)

    def _unchanged(self, image_rgb: NDArray[np.uint8], bboxes_xyxy: NDArray[np.float64]
                   ) -> dict[int, NDArray[np.float32]]:
        """Return the embeddings of unchanged crops, by the rows of their boxes.

        Each crop is compared with the crop that was embedded, so that slow changes are noticed.
        """
        if not self._known:
            return {}
        boxes, found = np.array([known.bbox_xyxy for known in self._known]), {}
        for row, (bbox, picture) in enumerate(zip(bboxes_xyxy, _pictures(image_rgb, bboxes_xyxy),
                                                  strict=True)):
            near = np.nonzero(np.abs(boxes - bbox).max(axis=1) <= _MOVED_PX)[0]
            for candidate in reversed(near):
                change = np.abs(picture - self._known[candidate].picture)
                if change.mean() < _CHANGED and change.max() < _CELL_CHANGED:
                    found[row] = self._known[candidate].embedding
                    break
        return found

    def encode(self, image_rgb: NDArray[np.uint8], bboxes_xyxy: NDArray[np.float64]
               ) -> NDArray[np.float32]:
        """Encode and store the embeddings (n, d) of at least one crop."""
        embeddings = self._encode(image_rgb, bboxes_xyxy)
        self._known.extend(map(_Known, bboxes_xyxy, _pictures(image_rgb, bboxes_xyxy), embeddings))
        return embeddings

    def _encode(self, image_rgb: NDArray[np.uint8], bboxes_xyxy: NDArray[np.float64]
                ) -> NDArray[np.float32]:
        start = time.monotonic()
        embeddings = self._encoder.encode_crops(image_rgb, bboxes_xyxy)
        self._crop_s = (time.monotonic() - start) / len(bboxes_xyxy)
        return embeddings

    def similarities(self, embeddings: NDArray[np.float32]) -> CropSimilarities:
        """Return the similarities of crops, given by embeddings (n, d), to the labels."""
        return CropSimilarities(embeddings.reshape(-1, self._labels.unique.shape[1]), self._labels)


class ObservedCrops:
    """The crops of an image; a crop is encoded when it is compared for the first time.

    ``known`` has known embeddings (d,) of crops by row.
    """

    def __init__(self, observer: Observer, image_rgb: NDArray[np.uint8],
                 bboxes_xyxy: NDArray[np.float64], known: Mapping[int, NDArray[np.float32]]
                 ) -> None:
        self._observer, self._image_rgb, self._bboxes_xyxy = observer, image_rgb, bboxes_xyxy
        self._known = dict(known)

    @property
    def known(self) -> NDArray[np.int64]:
        """Return the rows (m,) of the crops that are encoded."""
        return np.array(sorted(self._known), dtype=np.int64)

    def compare(self, rows: NDArray[np.int64]) -> CropSimilarities:
        """Return the similarities (m, L) of crops, given by rows (m,), to the labels."""
        new = np.array([row for row in rows.tolist() if row not in self._known], dtype=np.int64)
        if len(new):
            self._known.update(zip(new.tolist(), self._observer.encode(
                self._image_rgb, self._bboxes_xyxy[new]), strict=True))
        return self._observer.similarities(
            np.array([self._known[row] for row in rows.tolist()], dtype=np.float32))
