# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Associate boxes with landmarks: one to one in every frame, with the greatest total overlap."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from cliploc_ros.core.kernels.compiled import compiled
from cliploc_ros.offline.mapping.landmarks import Landmarks, box_iou, project_box
from cliploc_ros.offline.mapping.views import Views

#: A box and a landmark that overlap less do not belong together.
ASSOCIATION_IOU = 0.2


def find_overlaps(views: Views, landmarks: Landmarks, min_iou: float
                  ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return the pairs of a box and a landmark with its class that overlap by more than min_iou.

    They are the boxes, the landmarks, and the IoUs of box and projected box, clipped to the image
    (p,), in the order of the boxes.
    """
    names = landmarks.names[np.argsort(landmarks.names[:, 1], kind='stable')]
    starts = np.searchsorted(names[:, 1], np.arange(views.classes.max(initial=0) + 2))
    boxes, numbers, ious = _overlaps(views, landmarks.centers, landmarks.bases, names[:, 0],
                                     starts, min_iou)
    order = np.lexsort((numbers, boxes))
    return boxes[order], numbers[order], ious[order]


@compiled
def _overlaps(views, centers, bases, members, starts, min_iou):
    """Return boxes, landmarks and IoUs.

    Class k has the landmarks members[starts[k]:starts[k + 1]].
    """
    boxes, landmarks, ious = [], [], []
    projected = np.empty((len(centers), 4))
    projected_in = np.full(len(centers), -1)
    visible = np.zeros(len(centers), dtype=np.bool_)
    for row in range(len(views.frames)):
        frame, number = views.frames[row], views.classes[row]
        for landmark in members[starts[number]:starts[number + 1]]:
            if projected_in[landmark] != frame:
                projected_in[landmark] = frame
                visible[landmark] = project_box(
                    views.rotations[frame], views.translations[frame], centers[landmark],
                    bases[landmark], projected[landmark])
            if not visible[landmark]:
                continue
            iou = box_iou(projected[landmark], views.edges[row], views.bounds[frame])
            if iou > min_iou:
                boxes.append(row)
                landmarks.append(landmark)
                ious.append(iou)
    return np.array(boxes), np.array(landmarks), np.array(ious)


def associate(views: Views, landmarks: Landmarks, min_iou: float = ASSOCIATION_IOU,
              among: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
    """Return the landmark (n,) that each box shows, -1 for none.

    In every frame a landmark has at most one box and a box at most one landmark; the sum of their
    IoUs is the greatest possible (Hungarian method). Pairs that overlap by less than min_iou are
    not candidates, nor are landmarks that the mask among (L,) excludes.
    """
    boxes, candidates, ious = find_overlaps(views, landmarks, min_iou)
    if among is not None:
        kept = among[candidates]
        boxes, candidates, ious = boxes[kept], candidates[kept], ious[kept]
    shown = np.full(len(views.frames), -1, dtype=np.int64)
    frames = views.frames[boxes]
    sole = _is_sole(boxes) & _is_sole(frames * len(landmarks.centers) + candidates)
    shown[boxes[sole]] = candidates[sole]
    contested = np.nonzero(~sole)[0]
    for part in np.split(contested, np.nonzero(np.diff(frames[contested]))[0] + 1):
        rows, row_of = np.unique(boxes[part], return_inverse=True)
        columns, column_of = np.unique(candidates[part], return_inverse=True)
        gains = np.zeros((len(rows), len(columns)))
        gains[row_of, column_of] = ious[part]
        for row, column in zip(*linear_sum_assignment(gains, maximize=True), strict=True):
            if gains[row, column] > 0.0:
                shown[rows[row]] = columns[column]
    return shown


def _is_sole(values: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell which values occur once."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray(counts[inverse] == 1)


@compiled
def ious_with(views, rows, center, basis):
    """Return the IoU of an ellipsoid with each of some boxes; 0 if it is behind the camera."""
    ious, box = np.zeros(len(rows)), np.empty(4)
    for place in range(len(rows)):
        frame = views.frames[rows[place]]
        if project_box(views.rotations[frame], views.translations[frame], center, basis, box):
            ious[place] = box_iou(box, views.edges[rows[place]], views.bounds[frame])
    return ious
