# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measure how well the frames support each landmark, and which of them show its place.

Maps have no walls. A place therefore counts as in view only if the frame also shows another
landmark in nearly the same direction that is no nearer.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.kernels.compiled import compiled
from cliploc_ros.core.map import visibility
from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.visibility import HIDDEN_SHARE, SHOWN_SHARE
from cliploc_ros.offline.mapping.association import find_overlaps, ious_with
from cliploc_ros.offline.mapping.fitting import centre_covariance
from cliploc_ros.offline.mapping.landmarks import Landmarks, group_boxes, project_box
from cliploc_ros.offline.mapping.options import MappingOptions
from cliploc_ros.offline.mapping.views import Views

#: A landmark is expected up to this multiple of the greatest distance at which it was detected.
REACH = 1.2
#: Least median IoU with its boxes that a landmark of a map needs.
MIN_MEDIAN_IOU = 0.5
#: The centre of a large landmark may deviate by this share of its size.
MAX_SIGMA_SHARE = 0.2
# A landmark explains a box of its class if their IoU is greater than this.
_EXPLAINED_IOU = 0.3
# For a class with fewer boxes, the least size of a detection is that of its boxes or of all
# classes, whichever is larger.
_FEW_BOXES = 20
_LEAST_QUANTILE = 0.1
# Points of a box that are tested for occlusion: those of a 5 x 5 grid within the ellipse.
_GRID = np.array([(x, y) for x in (-0.8, -0.4, 0.0, 0.4, 0.8) for y in (-0.8, -0.4, 0.0, 0.4, 0.8)
                  if x * x + y * y < 1.0])

_is_in_image, _is_beside = compiled(visibility.is_in_image), compiled(visibility.is_beside)


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
    last_seen: NDArray[np.float64]  #: (L,): [s]; NaN without any box
    seen: NDArray[np.float64]  #: (L,): those of the expected frames that show it

    @property
    def seen_ratio(self) -> NDArray[np.float64]:
        """Return the share of the expected frames (L,) in which a landmark was detected."""
        return np.asarray(np.minimum(1.0, self.support / np.maximum(1, self.expected)))

    def details(self, row: int, given: LandmarkDetails) -> LandmarkDetails:
        """Return the given details of a landmark, updated with this evidence."""
        return replace(
            given, position_sigma=float(self.position_sigma[row]), support=int(self.support[row]),
            seen_ratio=float(self.seen_ratio[row]), baseline_deg=float(self.baseline_deg[row]),
            last_seen=float(self.last_seen[row]))


def gather_evidence(views: Views, landmarks: Landmarks, shown: NDArray[np.int64]) -> Evidence:
    """Return the evidence for each landmark from the boxes that show it."""
    cameras = views.centers
    columns: list[tuple[float, ...]] = []
    for center, basis, rows in zip(landmarks.centers, landmarks.bases,
                                   group_boxes(shown, len(landmarks.centers)), strict=True):
        if len(rows) == 0:
            columns.append((0, 0, 0, 0.0, np.inf, 0.0, np.nan, 0))
            continue
        frames = views.frames[rows]
        offsets = center - cameras[frames]
        distances = np.linalg.norm(offsets, axis=1)
        expected = is_expected(views, cameras, center, basis, REACH * distances.max())
        columns.append((
            len(rows), len(np.unique(views.viewpoints[frames])), expected.sum(),
            widest_angle_deg(offsets / distances[:, None]),
            np.sqrt(np.linalg.eigvalsh(centre_covariance(views, rows, center, basis))[-1]),
            np.median(ious_with(views, rows, center, basis)), views.stamps_s[frames].max(),
            expected[np.unique(frames)].sum()))
    values = np.array(columns, dtype=np.float64).reshape(-1, 8).T
    return Evidence(*values[:3].astype(np.int64), *values[3:])


def best_ious(views: Views, landmarks: Landmarks) -> NDArray[np.float64]:
    """Return the greatest IoU (n,) of each box with any landmark of its class, 0 for none."""
    boxes, _, ious = find_overlaps(views, landmarks, 0.0)
    best = np.zeros(len(views.frames))
    np.maximum.at(best, boxes, ious)
    return best


def widest_angle_deg(directions: NDArray[np.float64]) -> float:
    """Return the greatest angle [deg] between any two unit vectors (m, 3), within 2 degrees."""
    cells = np.unique(np.round(directions / 0.03), axis=0)
    cells /= np.linalg.norm(cells, axis=1, keepdims=True)
    return float(np.degrees(np.arccos(np.clip((cells @ cells.T).min(), -1.0, 1.0))))


@compiled
def is_expected(views, cameras, center, basis, reach):
    """Return a mask of the frames (F,) in which an ellipsoid is visible within reach [m]."""
    expected, box = np.zeros(len(cameras), dtype=np.bool_), np.empty(4)
    for frame in range(len(cameras)):
        if np.square(center - cameras[frame]).sum() > reach * reach:
            continue
        expected[frame] = project_box(
            views.rotations[frame], views.translations[frame], center, basis, box
        ) and _is_in_image(box, views.bounds[frame], SHOWN_SHARE)
    return expected


def reasons_against(landmarks: Landmarks, evidence: Evidence, options: MappingOptions
                    ) -> list[str | None]:
    """Return for each landmark why it is left out of the map; None if it is good enough."""
    # size by volume: an ellipsoid that is stretched along the rays is uncertain, not large
    sizes_m = np.sqrt(3.0) * np.cbrt(np.abs(np.linalg.det(landmarks.bases)))
    return [_reason(evidence, number, size_m, options)
            for number, size_m in enumerate(sizes_m.tolist())]


def _reason(evidence: Evidence, number: int, size_m: float, options: MappingOptions) -> str | None:
    """Return the first reason against a landmark, or None."""
    viewpoints, ratio = evidence.viewpoints[number], evidence.seen_ratio[number]
    baseline, sigma = evidence.baseline_deg[number], evidence.position_sigma[number]
    if viewpoints < options.min_viewpoints:
        return f'seen from too few viewpoints: {viewpoints}, fewer than {options.min_viewpoints}'
    if ratio < options.min_seen_ratio:
        return f'rarely detected, or moved: seen in {_floor(100 * ratio)} % of the frames that ' \
               f'show its place, less than {100 * options.min_seen_ratio:g} %'
    if baseline < options.min_baseline_deg:
        return f'seen from one side only: {_floor(baseline)} degrees, less than ' \
               f'{options.min_baseline_deg:g}'
    if sigma > max(options.max_position_sigma_m, MAX_SIGMA_SHARE * size_m):
        return f'uncertain position: {sigma:.2f} m'
    if evidence.median_iou[number] < MIN_MEDIAN_IOU:
        return f'boxes do not fit one ellipsoid: median IoU {evidence.median_iou[number]:.2f}'
    return None


def _floor(value: float) -> str:
    """Format a value with one decimal, rounded down: 19.97 stays below 20."""
    return f'{np.floor(10.0 * value) / 10.0:.1f}'


@dataclass(frozen=True)
class BoxQuality:
    """The share of boxes that landmarks explain, and how well they fit."""

    boxes: int
    #: Share of the boxes that a landmark of their class overlaps by more than an IoU of 0.3
    explained: float
    median_iou: float  #: Of these boxes
    @staticmethod
    def of(ious: NDArray[np.float64]) -> 'BoxQuality':
        """Summarize the best IoU (n,) of each box with a landmark of its class."""
        is_explained = ious > _EXPLAINED_IOU
        return BoxQuality(len(ious), float(is_explained.mean()) if len(ious) else 0.0,
                          float(np.median(ious[is_explained])) if is_explained.any() else 0.0)


def explained_boxes(views: Views, landmarks: Landmarks, shown: NDArray[np.int64] | None = None
                    ) -> BoxQuality:
    """Measure how well landmarks explain boxes.

    The landmark that a box shows may explain it even if their classes differ.
    """
    ious = best_ious(views, landmarks)
    if shown is not None:
        for number, rows in enumerate(group_boxes(shown, len(landmarks.centers))):
            own = ious_with(views, rows, landmarks.centers[number], landmarks.bases[number])
            ious[rows] = np.maximum(ious[rows], own)
    return BoxQuality.of(ious)


class Sight(NamedTuple):
    """Count viewpoints and frames in which each of L places was in view, and its landmark seen."""

    #: (L,): viewpoints
    expected: NDArray[np.int64]
    seen: NDArray[np.int64]
    #: (L,): frames
    expected_frames: NDArray[np.int64]
    seen_frames: NDArray[np.int64]

    @property
    def seen_ratio(self) -> NDArray[np.float64]:
        """Return the share (L,) of the frames in view in which each landmark was seen."""
        return np.asarray(self.seen_frames / np.maximum(1, self.expected_frames))

    def words(self, place: int) -> str:
        """Describe in how many frames a landmark was expected and seen."""
        return (f'expected in {self.expected_frames[place]} frames, seen in '
                f'{self.seen_frames[place]}')

    def select(self, rows: slice | NDArray[np.int64]) -> 'Sight':
        """Return the counts of the given places."""
        return Sight(*(column[rows] for column in self))


def look_for(views: Views, places: Landmarks, shown: NDArray[np.int64],
             is_solid: NDArray[np.bool_]) -> Sight:
    """Count the viewpoints and frames with each place in view, and with its landmark detected.

    A place of class -1 has a class without boxes. Solid places contain an object, which may hide
    others.
    """
    extents = _least_extents(views, int(places.classes.max(initial=0)))
    least = np.where(places.classes < 0, extents[-1], extents[places.classes])
    radii = np.linalg.norm(places.bases, axis=1).max(axis=1, initial=0.0)
    return Sight(*_count_views(
        views, places.centers, places.bases, radii, 2.0 * radii / np.maximum(least, 1e-6), least,
        is_solid, shown))


def _least_extents(views: Views, last_class: int) -> NDArray[np.float64]:
    """Return the least size of detected boxes, by class, on the plane z = 1.

    The last entry is for all classes together.
    """
    sides = np.maximum(views.edges[:, 2:] - views.edges[:, :2], 0.0)
    extents = np.sqrt(sides.prod(axis=1))
    whole = ~views.is_open.any(axis=1)
    overall = float(np.quantile(extents[whole], _LEAST_QUANTILE)) if whole.any() else 0.0
    result = np.full(last_class + 2, overall)
    for number in range(last_class + 1):
        own = extents[whole & (views.classes == number)]
        if len(own) >= _FEW_BOXES:
            result[number] = np.quantile(own, _LEAST_QUANTILE)
        elif len(own):
            result[number] = max(overall, float(own.min()))
    return result


@compiled
def _count_views(views, centers, bases, radii, reaches, least, is_solid, shown):
    """Return the columns (4, L) of a Sight."""
    count = len(centers)
    farthest = reaches.max() if count else 0.0
    boxes, near = np.empty((count, 4)), np.empty(count, dtype=np.int64)
    counts = np.zeros((4, count), dtype=np.int64)
    # the latest viewpoint of each camera that counts, for "in view" and for "seen"
    latest = np.full((2, views.cameras.max() + 1 if len(views.cameras) else 0, count), -1)
    for frame in range(len(views.rotations)):
        first, last = views.offsets[frame], views.offsets[frame + 1]
        rotation, translation = views.rotations[frame], views.translations[frame]
        offsets = centers @ rotation.T + translation
        distances = np.sqrt((offsets * offsets).sum(axis=1))
        in_front = 0
        for place in range(count):
            if 0.0 < offsets[place, 2] <= farthest and project_box(
                    rotation, translation, centers[place], bases[place], boxes[place]):
                near[in_front] = place
                in_front += 1
        was_seen = np.zeros(count, dtype=np.bool_)
        numbers = shown[first:last]
        was_seen[numbers[numbers >= 0]] = True
        in_view = was_seen.copy()
        for i in range(in_front):
            place = near[i]
            box = boxes[place]
            if distances[place] > reaches[place] or not _is_in_image(
                    box, views.bounds[frame], SHOWN_SHARE):
                continue
            # large enough to be detected
            if (box[2] - box[0]) * (box[3] - box[1]) < least[place] * least[place]:
                continue
            if not _has_beside(place, near[:in_front], was_seen, offsets, distances):
                continue
            in_view[place] |= _hidden(
                place, near[:in_front], boxes, distances, radii, is_solid, shown, views.edges,
                first, last) <= HIDDEN_SHARE
        camera, viewpoint = views.cameras[frame], views.viewpoints[frame]
        for kind, counted in enumerate((in_view, was_seen)):
            counts[2 + kind] += counted
            counts[kind] += counted & (latest[kind, camera] != viewpoint)
            latest[kind, camera][counted] = viewpoint
    return counts


@compiled
def _has_beside(place, near, was_seen, offsets, distances):
    """Tell whether a frame shows another landmark beside a place or behind it."""
    for other in near:
        if other == place or not was_seen[other]:
            continue
        cosine = (offsets[other] * offsets[place]).sum() / (distances[other] * distances[place])
        if _is_beside(cosine, distances[other], distances[place]):
            return True
    return False


@compiled
def _hidden(place, near, boxes, distances, radii, is_solid, shown, edges, first, last):
    """Return the share of a place hidden by nearer landmarks or by boxes without a landmark."""
    box = boxes[place]
    x0, y0 = 0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])
    a, b = 0.5 * (box[2] - box[0]), 0.5 * (box[3] - box[1])
    count = 0
    for k in range(len(_GRID)):
        x, y = x0 + a * _GRID[k, 0], y0 + b * _GRID[k, 1]
        for other in near:
            if (is_solid[other] and other != place
                    and distances[other] + radii[other] < distances[place]
                    and _covers(boxes[other], x, y)):
                count += 1
                break
        else:
            for row in range(first, last):
                if shown[row] < 0 and _covers(edges[row], x, y):
                    count += 1
                    break
    return count / len(_GRID)


@compiled
def _covers(box, x, y):
    """Tell whether a point lies in the ellipse of a box."""
    dx = (2.0 * x - box[0] - box[2]) / (box[2] - box[0])
    dy = (2.0 * y - box[1] - box[3]) / (box[3] - box[1])
    return dx * dx + dy * dy < 1.0
