# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How well the frames support each landmark."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.kernels.compiled import compiled
from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.offline.mapping.association import find_overlaps, ious_with
from cliploc_ros.offline.mapping.fitting import accumulate
from cliploc_ros.offline.mapping.landmarks import (
    LANDMARK_SIZE,
    Landmarks,
    group_boxes,
    is_in_image,
    project_box,
)
from cliploc_ros.offline.mapping.options import MappingOptions
from cliploc_ros.offline.mapping.views import Views, camera_centers

#: A landmark is expected from no farther away than this times the greatest distance at which it
#: was detected.
REACH = 1.2
# IoU from which a landmark explains a box of its class.
_EXPLAINED_IOU = 0.3


class Evidence(NamedTuple):
    """The support of each of L landmarks."""

    #: (L,): frames that show it, their viewpoints, and frames that should show it
    support: NDArray[np.int64]
    viewpoints: NDArray[np.int64]
    expected: NDArray[np.int64]
    #: (L,): greatest angle between two directions from which it was seen [deg]
    baseline_deg: NDArray[np.float64]
    #: (L,): standard deviation of the centre on its worst axis [m]
    position_sigma: NDArray[np.float64]
    median_iou: NDArray[np.float64]  #: (L,): of its boxes; 0 without any
    last_seen: NDArray[np.float64]  #: (L,): [s]; NaN where nothing shows it

    @property
    def seen_ratio(self) -> NDArray[np.float64]:
        """Return the share of the expected frames (L,) in which a landmark was detected."""
        return np.asarray(np.minimum(1.0, self.support / np.maximum(1, self.expected)))

    def select(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> 'Evidence':
        """Return the evidence for some of the landmarks."""
        return self._replace(**{name: column[rows] for name, column in self._asdict().items()})

    def details(self, row: int, given: LandmarkDetails) -> LandmarkDetails:
        """Return the details of a landmark in a map with this evidence in place of the given."""
        return replace(
            given, position_sigma=float(self.position_sigma[row]), support=int(self.support[row]),
            seen_ratio=float(self.seen_ratio[row]), baseline_deg=float(self.baseline_deg[row]),
            last_seen=float(self.last_seen[row]))


def gather_evidence(views: Views, landmarks: Landmarks, shown: NDArray[np.int64]) -> Evidence:
    """Return the evidence for each landmark from the boxes that show it."""
    cameras = camera_centers(views)
    columns: list[tuple[float, ...]] = []
    for center, basis, rows in zip(landmarks.centers, landmarks.bases,
                                   group_boxes(shown, len(landmarks.centers)), strict=True):
        if len(rows) == 0:
            columns.append((0, 0, 0, 0.0, np.inf, 0.0, np.nan))
            continue
        frames = views.frames[rows]
        offsets = center - cameras[frames]
        distances = np.linalg.norm(offsets, axis=1)
        information = np.zeros((LANDMARK_SIZE, LANDMARK_SIZE))
        accumulate(views, rows, center, basis, information, np.zeros(LANDMARK_SIZE))
        try:
            variance = np.linalg.eigvalsh(np.linalg.inv(information)[:3, :3])[-1]
        except np.linalg.LinAlgError:  # boxes that the image cuts on all sides leave it open
            variance = np.inf
        columns.append((
            len(rows), len(np.unique(views.viewpoints[frames])),
            is_expected(views, cameras, center, basis, REACH * distances.max()).sum(),
            widest_angle_deg(offsets / distances[:, None]),
            # rounding makes what no box restrains negative
            np.sqrt(variance) if variance > 0.0 else np.inf,
            np.median(ious_with(views, rows, center, basis)), views.stamps_s[frames].max()))
    values = np.array(columns, dtype=np.float64).reshape(-1, 7).T
    return Evidence(*values[:3].astype(np.int64), *values[3:])


def best_ious(views: Views, landmarks: Landmarks) -> NDArray[np.float64]:
    """Return the greatest IoU (n,) of each box with any landmark of its class, 0 for none."""
    overlaps = find_overlaps(views, landmarks, 0.0)
    best = np.zeros(len(views.frames))
    np.maximum.at(best, overlaps.boxes, overlaps.ious)
    return best


def widest_angle_deg(directions: NDArray[np.float64]) -> float:
    """Return the greatest angle [deg] between two of m unit vectors (m, 3), to 2 degrees."""
    cells = np.unique(np.round(directions / 0.03), axis=0)
    cells /= np.linalg.norm(cells, axis=1, keepdims=True)
    return float(np.degrees(np.arccos(np.clip((cells @ cells.T).min(), -1.0, 1.0))))


@compiled
def is_expected(views, cameras, center, basis, reach):
    """Return the frames (F,) that show an ellipsoid, from no farther away than reach [m]."""
    expected, box = np.zeros(len(cameras), dtype=np.bool_), np.empty(4)
    for frame in range(len(cameras)):
        distance_2 = 0.0
        for i in range(3):
            distance_2 += (center[i] - cameras[frame, i]) ** 2
        if distance_2 > reach * reach:
            continue
        expected[frame] = project_box(
            views.rotations[frame], views.translations[frame], center, basis, box
        ) and is_in_image(box, views.bounds[frame])
    return expected


def reasons_against(landmarks: Landmarks, evidence: Evidence, options: MappingOptions
                    ) -> list[str | None]:
    """Return for each landmark why it stays out of the map; None where it belongs into it."""
    return [_reason(evidence, number, float(np.linalg.norm(basis)), options)
            for number, basis in enumerate(landmarks.bases)]


def _reason(evidence: Evidence, number: int, size_m: float, options: MappingOptions
            ) -> str | None:
    """Return the first reason against a landmark, or None."""
    viewpoints, ratio = evidence.viewpoints[number], evidence.seen_ratio[number]
    baseline, sigma = evidence.baseline_deg[number], evidence.position_sigma[number]
    if viewpoints < options.min_viewpoints:
        return f'seen from {viewpoints} viewpoints, not {options.min_viewpoints}'
    if ratio < options.min_seen_ratio:
        return f'seen in {_floor(100 * ratio)} % of the frames that show its place, not ' \
               f'{100 * options.min_seen_ratio:g} %: rarely detected, or moved'
    if baseline < options.min_baseline_deg:
        return f'seen from one side only: {_floor(baseline)} degrees, not ' \
               f'{options.min_baseline_deg:g}'
    if sigma > max(options.max_position_sigma_m, options.max_position_sigma_share * size_m):
        return f'its position is uncertain: {sigma:.2f} m'
    if evidence.median_iou[number] < options.min_median_iou:
        return f'its boxes do not fit one ellipsoid: median IoU {evidence.median_iou[number]:.2f}'
    return None


def _floor(value: float) -> str:
    """Return one decimal, never rounded up: 19.97 stays below 20."""
    return f'{np.floor(10.0 * value) / 10.0:.1f}'


def explained_boxes(views: Views, landmarks: Landmarks, shown: NDArray[np.int64] | None = None
                    ) -> tuple[float, float]:
    """Return the share of boxes that landmarks explain, and the median IoU of these boxes.

    The landmark that a box shows explains it although its class is another one.
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
