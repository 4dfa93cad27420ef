# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pre- and postprocessing of YOLO, as in ultralytics, without PyTorch."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

# Grey of the borders, and greatest number of boxes that are compared, as in training.
_GREY = (114, 114, 114)
_MOST_BOXES = 30_000
# Columns of the output of a network that removes duplicates itself: box, score, class.
_END2END = 6


@dataclass(frozen=True)
class Letterbox:
    """The place of an image in a network's input: scaled, and centred in grey borders [px]."""

    image_size: tuple[int, int]  #: Width and height of the image
    scaled_size: tuple[int, int]  #: Width and height of the scaled image
    #: Widths of the borders: left, top, right, bottom
    borders: tuple[int, int, int, int]

    @staticmethod
    def of(image_size: tuple[int, int], height: int, width: int, stride: int | None
           ) -> 'Letterbox':
        """Fit an image into an input; with a stride, the input shrinks to a multiple of it."""
        scale = min(height / image_size[1], width / image_size[0])
        scaled = max(round(image_size[0] * scale), 1), max(round(image_size[1] * scale), 1)
        free_x, free_y = width - scaled[0], height - scaled[1]
        if stride is not None:
            free_x, free_y = free_x % stride, free_y % stride
        return Letterbox(image_size, scaled, (
            round(free_x / 2 - 0.1), round(free_y / 2 - 0.1),
            round(free_x / 2 + 0.1), round(free_y / 2 + 0.1)))

    def fill(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Scale an image (h, w, 3) and add borders, giving an input (H, W, 3)."""
        if self.scaled_size != self.image_size:
            image = cv2.resize(image, self.scaled_size, interpolation=cv2.INTER_LINEAR)
        left, top, right, bottom = self.borders
        return np.asarray(cv2.copyMakeBorder(image, top, bottom, left, right,
                                             cv2.BORDER_CONSTANT, value=_GREY))

    def in_image(self, boxes_xyxy: NDArray[np.float32]) -> NDArray[np.float32]:
        """Convert boxes (n, 4) in the input to boxes in the image, clipped to it."""
        scaled, size, corner = (np.array(pair * 2, dtype=np.float32) for pair in
                                (self.scaled_size, self.image_size, self.borders[:2]))
        return np.clip((boxes_xyxy - corner) / (scaled / size), 0, size)


def select_boxes(output: NDArray[np.float32], conf: float, iou: float, max_det: int,
                 is_end2end: bool) -> NDArray[np.float32]:
    """Return the boxes (n, 6) of an output: left, top, right, bottom, score, class.

    The output is (4 + classes, boxes), with centre and size of each box. A network that removes
    duplicates itself has the output (boxes, 6 or more), the most confident box first.
    """
    if is_end2end or output.shape[-1] == _END2END:
        return output[output[:, 4] > conf][:max_det, :_END2END]
    scores = output[4:].max(axis=0)
    rows = np.flatnonzero(scores > conf)
    rows = rows[np.argsort(-scores[rows], kind='stable')[:_MOST_BOXES]]
    middle, half = output[:2, rows].T, output[2:4, rows].T / 2
    classes = output[4:, rows].argmax(axis=0)
    boxes = np.hstack([middle - half, middle + half])
    kept = without_doubles(boxes, classes, iou, max_det)
    return np.hstack([boxes, scores[rows][:, None], classes[:, None]])[kept].astype(np.float32)


def without_doubles(boxes_xyxy: NDArray[np.floating], classes: NDArray[np.number], iou: float,
                    most: int) -> NDArray[np.int64]:
    """Return the rows of boxes (n, 4) that remain after non-maximum suppression by class.

    The boxes are sorted, the best first. A box is dropped if its IoU with a kept box of its class
    exceeds ``iou``.
    """
    left, top, right, bottom = boxes_xyxy.T
    areas = (right - left) * (bottom - top)
    is_open = np.ones(len(boxes_xyxy), dtype=bool)
    kept: list[int] = []
    for row in range(len(boxes_xyxy)):
        if not is_open[row]:
            continue
        kept.append(row)
        if len(kept) == most:
            break
        later = row + 1 + np.flatnonzero(is_open[row + 1:] & (classes[row + 1:] == classes[row]))
        width = np.minimum(right[row], right[later]) - np.maximum(left[row], left[later])
        height = np.minimum(bottom[row], bottom[later]) - np.maximum(top[row], top[later])
        shared = np.maximum(width, 0) * np.maximum(height, 0)
        # not divided by the union, which is 0 for boxes without area
        is_open[later[shared > np.float32(iou) * (areas[row] + areas[later] - shared)]] = False
    return np.array(kept, dtype=np.int64)
