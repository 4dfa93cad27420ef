# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What mapping says about its result: what it found, what it left out and why."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.mapping.evidence import Evidence, best_ious, ious_with
from cliploc_ros.mapping.landmarks import Landmarks, group_boxes
from cliploc_ros.mapping.posed_detections import PosedDetections
from cliploc_ros.mapping.views import Views

# IoU from which a landmark explains a box of its class.
_EXPLAINED_IOU = 0.3
_REASONS_SHOWN = 10


@dataclass(frozen=True)
class LeftOut:
    """A landmark that is not good enough for the map."""

    class_id: str
    center: tuple[float, float, float]  #: [m]
    #: Frames that show it, and their viewpoints
    support: int
    viewpoints: int
    reason: str


@dataclass(frozen=True)
class MappingReport:
    """The result of mapping in numbers and words."""

    frames: int
    viewpoints: int
    boxes: int
    landmarks: int
    #: Share of the boxes that a landmark of their class overlaps by more than an IoU of 0.3
    explained: float
    #: Of these boxes. Both are measured on the frames that the map was fitted to.
    median_iou: float
    #: Root mean square by which joint refinement moved the poses
    pose_change_m: float
    pose_change_deg: float
    left_out: tuple[LeftOut, ...]
    notes: tuple[str, ...]  #: What is wrong with the input, and what to do about it

    def as_dict(self) -> dict[str, Any]:
        """Return the report as plain values, for JSON."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Return the report as text."""
        rows = [f'{self.landmarks} landmarks from {self.frames} frames of {self.viewpoints} '
                f'viewpoints with {self.boxes} boxes',
                f'explained boxes: {self.explained:.1%}, median IoU {self.median_iou:.3f} '
                '(on the frames used for fitting)']
        if self.pose_change_m > 0.0:
            rows.append(f'poses refined by {self.pose_change_m * 100:.1f} cm and '
                        f'{self.pose_change_deg:.2f} degrees (root mean square)')
        rows += [f'note: {note}' for note in self.notes]
        if self.left_out:
            rows.append(f'left out: {len(self.left_out)}')
        rows += [f'  {one.class_id} at {one.center[0]:.2f} {one.center[1]:.2f} '
                 f'{one.center[2]:.2f} with {one.support} frames: {one.reason}'
                 for one in self.left_out[:_REASONS_SHOWN]]
        if len(self.left_out) > _REASONS_SHOWN:
            rows.append(f'  and {len(self.left_out) - _REASONS_SHOWN} more')
        return rows


def explained_boxes(views: Views, landmarks: Landmarks, shown: NDArray[np.int64] | None = None
                    ) -> tuple[float, float]:
    """Return the share of boxes that landmarks explain, and the median IoU of these boxes.

    Parameters
    ----------
    shown : ndarray (n,) of int, optional
        The landmark that each box shows, -1 for none: explains a box although the landmark's
        class is another one.
    """
    ious = best_ious(views, landmarks)
    if shown is not None:
        for number, rows in enumerate(group_boxes(shown, len(landmarks.centers))):
            own = ious_with(views, rows, landmarks.centers[number], landmarks.bases[number])
            ious[rows] = np.maximum(ious[rows], own)
    return explained(ious)


def explained(ious: NDArray[np.float64]) -> tuple[float, float]:
    """Return the share of boxes that landmarks explain, by their best IoUs, and the median IoU."""
    is_explained = ious > _EXPLAINED_IOU
    if not is_explained.any():
        return 0.0, 0.0
    return float(is_explained.mean()), float(np.median(ious[is_explained]))


def describe_left_out(detections: PosedDetections, landmarks: Landmarks, evidence: Evidence,
                      reasons: Sequence[str]) -> tuple[LeftOut, ...]:
    """Return what was left out, that with the greatest support first."""
    x_y_z = landmarks.centers.round(3).tolist()
    return tuple(
        LeftOut(detections.class_names[landmarks.classes[row]], tuple(x_y_z[row]),
                int(evidence.support[row]), int(evidence.viewpoints[row]), reasons[row])
        for row in np.argsort(-evidence.support, kind='stable'))
