# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which box shows which landmark: one to one in every frame, by greatest overlap in sum."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from cliploc_ros.core.compiled import compiled
from cliploc_ros.mapping.landmarks import Landmarks
from cliploc_ros.mapping.projection import box_iou, project_box
from cliploc_ros.mapping.views import Views


class Overlaps(NamedTuple):
    """Pairs of a box and a landmark of its class that overlap, in the order of the boxes.

    Parameters
    ----------
    boxes, landmarks : ndarray (p,) of int
    ious : ndarray (p,)
        Of box and projected box, clipped to the image.
    """

    boxes: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    ious: NDArray[np.float64]


def find_overlaps(views: Views, landmarks: Landmarks, min_iou: float) -> Overlaps:
    """Return the pairs of equal class that overlap more than min_iou."""
    order = np.argsort(landmarks.classes, kind='stable')
    classes = max(views.classes.max(initial=0), landmarks.classes.max(initial=0)) + 1
    starts = np.searchsorted(landmarks.classes[order], np.arange(classes + 1))
    return Overlaps(*_overlaps(views, landmarks.centers, landmarks.bases, order, starts, min_iou))


@compiled
def _overlaps(views, centers, bases, order, starts, min_iou):
    """Return boxes, landmarks and IoUs; landmarks of class k are order[starts[k]:starts[k+1]]."""
    capacity = 4 * len(views.frames) + 64
    boxes, landmarks = np.empty(capacity, dtype=np.int64), np.empty(capacity, dtype=np.int64)
    ious = np.empty(capacity)
    count = 0
    projected = np.empty((len(centers), 4))
    projected_in = np.full(len(centers), -1)
    visible = np.zeros(len(centers), dtype=np.bool_)
    for row in range(len(views.frames)):
        frame, number = views.frames[row], views.classes[row]
        for place in range(starts[number], starts[number + 1]):
            landmark = order[place]
            if projected_in[landmark] != frame:
                projected_in[landmark] = frame
                visible[landmark] = project_box(
                    views.rotations[frame], views.translations[frame], centers[landmark],
                    bases[landmark], projected[landmark])
            if not visible[landmark]:
                continue
            iou = box_iou(projected[landmark], views.edges[row], views.bounds)
            if iou > min_iou:
                if count == capacity:
                    capacity *= 2
                    boxes = np.append(boxes, np.empty_like(boxes))
                    landmarks = np.append(landmarks, np.empty_like(landmarks))
                    ious = np.append(ious, np.empty_like(ious))
                boxes[count], landmarks[count], ious[count] = row, landmark, iou
                count += 1
    return boxes[:count].copy(), landmarks[:count].copy(), ious[:count].copy()


def associate(views: Views, landmarks: Landmarks, min_iou: float) -> NDArray[np.int64]:
    """Return the landmark (n,) that each box shows, -1 for none.

    In every frame a landmark has at most one box and a box at most one landmark; the sum of
    their IoUs is the greatest possible (Hungarian method).

    Parameters
    ----------
    views : Views
    landmarks : Landmarks
    min_iou : float
        Pairs that overlap less are no candidates.
    """
    boxes, candidates, ious = find_overlaps(views, landmarks, min_iou)
    shown = np.full(len(views.frames), -1, dtype=np.int64)
    if len(boxes) == 0:
        return shown
    frames = views.frames[boxes]
    sole = _is_sole(boxes) & _is_sole(frames * len(landmarks.centers) + candidates)
    shown[boxes[sole]] = candidates[sole]
    contested = np.nonzero(~sole)[0]
    bounds = np.nonzero(np.diff(frames[contested]))[0] + 1
    for part in np.split(contested, bounds):
        _assign(boxes[part], candidates[part], ious[part], shown)
    return shown


def _is_sole(values: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell which values occur once."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray(counts[inverse] == 1)


def _assign(boxes: NDArray[np.int64], candidates: NDArray[np.int64], ious: NDArray[np.float64],
            shown: NDArray[np.int64]) -> None:
    """Write the landmarks of the contested boxes of one frame."""
    rows, row_of = np.unique(boxes, return_inverse=True)
    columns, column_of = np.unique(candidates, return_inverse=True)
    gains = np.zeros((len(rows), len(columns)))
    gains[row_of, column_of] = ious
    for row, column in zip(*linear_sum_assignment(gains, maximize=True), strict=True):
        if gains[row, column] > 0.0:
            shown[rows[row]] = columns[column]
