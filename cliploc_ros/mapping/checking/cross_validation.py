# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cross-validation over time: landmarks fitted to some blocks of a recording, judged on others."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.mapping.checking.landmark_faults import Witness
from cliploc_ros.mapping.checking.options import CheckOptions
from cliploc_ros.mapping.evidence import best_ious
from cliploc_ros.mapping.fitting import fit_landmarks
from cliploc_ros.mapping.landmarks import Landmarks, group_boxes
from cliploc_ros.mapping.report import explained
from cliploc_ros.mapping.views import Views


class Fold(NamedTuple):
    """A part of a recording, and the map without it."""

    frames: NDArray[np.int64]  #: (k,): the frames to judge
    #: (l,): the landmarks of the whole map that the other frames suffice for
    rows: NDArray[np.int64]
    landmarks: Landmarks  #: These landmarks, fitted to the other frames


@dataclass(frozen=True)
class BoxQuality:
    """How well landmarks explain boxes."""

    boxes: int
    #: Share of the boxes that a landmark of their class overlaps by more than an IoU of 0.3
    explained: float
    median_iou: float  #: Of these


def split_frames(stamps_s: NDArray[np.float64], options: CheckOptions) -> NDArray[np.int64]:
    """Return the fold (F,) of each frame: blocks of time in turn, at least one block a fold."""
    elapsed = stamps_s - stamps_s[0]
    block_s = min(options.block_s, max(float(elapsed[-1]), 1e-9) / options.folds)
    return np.asarray((elapsed / block_s).astype(np.int64) % options.folds)


def make_folds(views: Views, witness: Witness, options: CheckOptions) -> Iterator[Fold]:
    """Return the folds of a recording, each with the map as the others show it.

    A landmark that fits its boxes is fitted again, to the boxes outside of the fold; it is left
    out if they are too few. A landmark that does not fit its boxes, or has none, stays as it is:
    a robot would use it as it is.
    """
    of_frames = split_frames(views.stamps_s, options)
    for number in range(options.folds):
        judged = np.nonzero(of_frames == number)[0]
        if len(judged):
            block_s = (views.stamps_s[-1] - views.stamps_s[0]) / options.folds
            gap = float(min(options.gap_s, 0.25 * block_s))
            training = ~_is_near(views.stamps_s, judged, gap)
            rows, landmarks = _refit(views, witness, training, options)
            yield Fold(judged, rows, landmarks)


def _is_near(stamps_s: NDArray[np.float64], judged: NDArray[np.int64], gap_s: float
             ) -> NDArray[np.bool_]:
    """Tell which frames (F,) are judged or within a gap of one that is."""
    times = stamps_s[judged]
    after = np.searchsorted(times, stamps_s).clip(0, len(times) - 1)
    before = (after - 1).clip(0)
    nearest = np.minimum(np.abs(times[after] - stamps_s), np.abs(times[before] - stamps_s))
    return np.asarray(nearest <= gap_s)


def _refit(views: Views, witness: Witness, training: NDArray[np.bool_], options: CheckOptions
           ) -> tuple[NDArray[np.int64], Landmarks]:
    landmarks, evidence = witness.landmarks, witness.evidence
    kept = np.ones(len(landmarks.centers), dtype=np.bool_)
    boxes = group_boxes(witness.shown, len(kept))
    for number, rows in enumerate(boxes):
        boxes[number] = rows[:0]
        if evidence.median_iou[number] < options.mapping.min_median_iou:
            continue
        rows = rows[training[views.frames[rows]]]
        seen_from = np.unique(views.viewpoints[views.frames[rows]])
        kept[number] = len(seen_from) >= options.mapping.min_viewpoints
        if kept[number]:
            boxes[number] = rows
    return np.nonzero(kept)[0], fit_landmarks(views, landmarks, boxes).select(kept)


def judge_boxes(views: Views, landmarks: Landmarks, frames: NDArray[np.int64] | None = None
                ) -> NDArray[np.float64]:
    """Return the best IoU of each box of some frames, or of all, with a landmark of its class."""
    ious = best_ious(views, landmarks)
    return ious if frames is None else ious[np.isin(views.frames, frames)]


def box_quality(ious: NDArray[np.float64]) -> BoxQuality:
    """Return how well landmarks explain boxes with these best IoUs."""
    return BoxQuality(len(ious), *explained(ious))


def fold_map(landmark_map: LandmarkMap, fold: Fold) -> LandmarkMap:
    """Return the map of a fold, with the ids and labels of the whole map."""
    rows = fold.rows
    semi_axes = np.linalg.norm(fold.landmarks.bases, axis=1)
    rotations = fold.landmarks.bases / semi_axes[:, None, :]
    rotations[np.linalg.det(rotations) < 0.0] *= -1.0
    details = landmark_map.details
    return replace(
        landmark_map, centers=fold.landmarks.centers, semi_axes=semi_axes,
        quats_xyzw=Rotation.from_matrix(rotations).as_quat(),
        landmark_ids=tuple(landmark_map.landmark_ids[row] for row in rows),
        labels=tuple(landmark_map.labels[row] for row in rows),
        class_ids=tuple(landmark_map.class_ids[row] for row in rows),
        details=tuple(details[row] for row in rows) if details else ())
