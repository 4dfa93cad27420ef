# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How good is a map, and what improves it? Checks of the map alone, and against observations."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.landmark_details import LandmarkDetails
from cliploc_ros.core.landmark_map import LandmarkMap
from cliploc_ros.mapping.association import associate
from cliploc_ros.mapping.building import build_map
from cliploc_ros.mapping.evidence import gather_evidence, group_boxes
from cliploc_ros.mapping.fitting import fit_ellipsoid
from cliploc_ros.mapping.landmarks import Landmarks, landmarks_of_map
from cliploc_ros.mapping.merging import pairs_of_one_class
from cliploc_ros.mapping.options import MappingOptions
from cliploc_ros.mapping.posed_detections import PosedDetections
from cliploc_ros.mapping.report import explained_boxes
from cliploc_ros.mapping.residuals import Residuals, mean_residuals
from cliploc_ros.mapping.views import Views, make_views

# Guesses: below these a landmark is reported.
_LEAST_THINNESS = 0.05
_DUPLICATE_DISTANCE = 0.5
# A landmark whose boxes put it this far away, beyond its uncertainty, was moved.
_LEAST_MOVE_M = 0.1
_MOVE_SIGMAS = 4.0
#: A pose needs so many landmarks.
MIN_MATCHES = 3
_LONGEST_PAUSE_S = 1.0


@dataclass(frozen=True)
class CheckedLandmark:
    """What is known of one landmark; None where it needs observations and has none.

    Parameters
    ----------
    landmark_id, class_id : str
    thinness : float
        Smallest semi-axis over the greatest.
    overlaps : tuple of str
        Landmarks of its class that lie in it.
    support : int
        Frames that show it.
    seen_ratio : float
        Share of the frames showing its place in which it was detected.
    baseline_deg : float
        Greatest angle between two directions from which it was seen [deg].
    position_sigma : float
        Standard deviation of its centre [m].
    offset_m : float
        From its centre to where its boxes put it [m].
    problems : tuple of str
    """

    landmark_id: str
    class_id: str
    thinness: float
    overlaps: tuple[str, ...]
    support: int | None
    seen_ratio: float | None
    baseline_deg: float | None
    position_sigma: float | None
    offset_m: float | None
    problems: tuple[str, ...] = ()


@dataclass(frozen=True)
class WeakSpan:
    """A stretch of a recording that shows too few landmarks to relocalize.

    Parameters
    ----------
    start_s, end_s : float
        Times of its first and last frame [s].
    frames : int
    most_landmarks : int
        Most landmarks that any of these frames shows.
    """

    start_s: float
    end_s: float
    frames: int
    most_landmarks: int


@dataclass(frozen=True)
class CheckedMap:
    """The result of checking a map; None where it needs observations.

    Parameters
    ----------
    landmarks : tuple of CheckedLandmark
    explained, median_iou : float
        Share of the boxes that a landmark of their class explains, and their median IoU.
    held_out_explained, held_out_iou : float
        The same of maps built from the other parts of the recording, mean over all parts.
    localizable : float
        Share of the frames that show at least three landmarks.
    landmarks_in_frames : tuple of int
        How many each frame shows.
    weak_spans : tuple of WeakSpan
        Longest first.
    residuals : Residuals
        Systematic differences of boxes and landmarks.
    advice : tuple of str
    """

    landmarks: tuple[CheckedLandmark, ...]
    advice: tuple[str, ...]
    explained: float | None = None
    median_iou: float | None = None
    held_out_explained: float | None = None
    held_out_iou: float | None = None
    localizable: float | None = None
    landmarks_in_frames: tuple[int, ...] = ()
    weak_spans: tuple[WeakSpan, ...] = ()
    residuals: Residuals | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the result as plain values, for JSON."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Return the result as text."""
        rows = [f'{len(self.landmarks)} landmarks, '
                f'{sum(bool(one.problems) for one in self.landmarks)} with problems']
        if self.explained is not None:
            rows.append(f'explained boxes: {self.explained:.1%}, median IoU {self.median_iou:.3f}')
            rows.append(f'frames with at least {MIN_MATCHES} landmarks: {self.localizable:.1%}')
        if self.held_out_explained is not None:
            rows.append(f'cross-validated: {self.held_out_explained:.1%}, median IoU '
                        f'{self.held_out_iou:.3f} (maps built without the part they explain)')
        rows += [f'  {one.landmark_id}: {"; ".join(one.problems)}'
                 for one in self.landmarks if one.problems]
        return rows + [f'advice: {text}' for text in self.advice]


def check_map(landmark_map: LandmarkMap, detections: PosedDetections | None = None,
              options: MappingOptions | None = None) -> CheckedMap:
    """Check a map, and compare it with observations where there are any.

    Parameters
    ----------
    landmark_map : LandmarkMap
    detections : PosedDetections, optional
        In the coordinate frame of the map.
    options : MappingOptions, optional
        What a good landmark is.
    """
    options = options or MappingOptions()
    rows = _check_alone(landmark_map)
    if detections is None:
        checked = tuple(_with_problems(row, options) for row in rows)
        return CheckedMap(checked, tuple(_advice(checked, (), None)))
    views = make_views(detections, options)
    landmarks = landmarks_of_map(landmark_map, detections.class_names)
    shown = associate(views, landmarks, options.association_iou)
    checked = tuple(_with_problems(row, options)
                    for row in _check_observed(rows, views, landmarks, shown))
    explained, median_iou = explained_boxes(views, landmarks)
    counts = np.bincount(views.frames[shown >= 0], minlength=len(detections))
    spans = _weak_spans(detections.stamps_s, counts)
    residuals = mean_residuals(detections, views, landmarks, shown)
    return CheckedMap(checked, tuple(_advice(checked, spans, residuals)), explained, median_iou,
                      localizable=float(np.mean(counts >= MIN_MATCHES)),
                      landmarks_in_frames=tuple(counts.tolist()), weak_spans=spans,
                      residuals=residuals)


def cross_validate(detections: PosedDetections, options: MappingOptions, parts: int = 4
                   ) -> tuple[float, float]:
    """Return explained boxes and IoU of maps built without the part that they are tested on.

    The recording is cut into three times as many blocks as there are parts; a part consists of
    every parts-th block, so that each map still sees most of the place.
    """
    blocks = np.arange(len(detections)) * 3 * parts // len(detections) % parts
    results = []
    for part in range(parts):
        built = build_map(detections.select_frames(np.nonzero(blocks != part)[0]), options)
        held_out = make_views(detections.select_frames(np.nonzero(blocks == part)[0]), options)
        landmarks = landmarks_of_map(built.landmark_map, detections.class_names)
        results.append(explained_boxes(held_out, landmarks))
    explained, iou = np.mean(results, axis=0)
    return float(explained), float(iou)


def _check_alone(landmark_map: LandmarkMap) -> list[CheckedLandmark]:
    """Return what the map itself says of its landmarks."""
    landmarks = landmarks_of_map(landmark_map, sorted(set(landmark_map.class_ids)))
    overlaps: list[list[str]] = [[] for _ in landmark_map.landmark_ids]
    for first, second in pairs_of_one_class(landmarks, _DUPLICATE_DISTANCE):
        overlaps[first].append(landmark_map.landmark_ids[second])
        overlaps[second].append(landmark_map.landmark_ids[first])
    thinness = landmark_map.semi_axes.min(axis=1) / landmark_map.semi_axes.max(axis=1)
    rows = []
    for row, landmark_id in enumerate(landmark_map.landmark_ids):
        known = landmark_map.details[row] if landmark_map.details else LandmarkDetails()
        rows.append(CheckedLandmark(
            landmark_id, landmark_map.class_ids[row], float(thinness[row]),
            tuple(overlaps[row]), known.support, known.seen_ratio, known.baseline_deg,
            known.position_sigma, None))
    return rows


def _check_observed(rows: list[CheckedLandmark], views: Views, landmarks: Landmarks,
                    shown: NDArray[np.int64]) -> list[CheckedLandmark]:
    """Return the landmarks with what the observations say of them."""
    evidence = gather_evidence(views, landmarks, shown)
    checked = []
    for row, boxes in enumerate(group_boxes(shown, len(rows))):
        if len(boxes) == 0:
            checked.append(replace(rows[row], support=0, seen_ratio=None, baseline_deg=None,
                                   position_sigma=None))
            continue
        fit = fit_ellipsoid(views, boxes, landmarks.centers[row], landmarks.bases[row])
        checked.append(replace(
            rows[row], support=int(evidence.support[row]),
            seen_ratio=float(evidence.seen_ratio[row]),
            baseline_deg=float(evidence.baseline_deg[row]),
            position_sigma=float(evidence.position_sigma[row]),
            offset_m=float(np.linalg.norm(fit.center - landmarks.centers[row]))))
    return checked


def _with_problems(one: CheckedLandmark, options: MappingOptions) -> CheckedLandmark:
    """Return a landmark with what is wrong with it."""
    problems = []
    if one.overlaps:
        problems.append(f'lies in {", ".join(one.overlaps[:3])}: probably one object, merge them')
    if one.thinness < _LEAST_THINNESS:
        problems.append(f'{one.thinness:.3f} times as thick as long; fit it again')
    if one.support == 0:
        problems.append('no frame shows it: removed, moved, or never seen')
    if one.seen_ratio is not None and one.seen_ratio < options.min_seen_ratio:
        problems.append(f'seen in only {one.seen_ratio:.1%} of the frames that show its place')
    if one.baseline_deg is not None and one.baseline_deg < options.min_baseline_deg:
        problems.append(f'seen from one side only ({one.baseline_deg:.0f} degrees); record the '
                        'other side')
    if one.position_sigma is not None and one.position_sigma > 2 * options.max_position_sigma_m:
        problems.append(f'its position is uncertain ({one.position_sigma:.2f} m); record it from '
                        'more directions')
    if one.offset_m is not None and one.position_sigma is not None and one.offset_m > max(
            _LEAST_MOVE_M, _MOVE_SIGMAS * one.position_sigma):
        problems.append(f'its boxes put it {one.offset_m:.2f} m away: moved, or badly fitted')
    return replace(one, problems=tuple(problems))


def _weak_spans(stamps_s: NDArray[np.float64], counts: NDArray[np.int64]
                ) -> tuple[WeakSpan, ...]:
    """Return the stretches of frames that show too few landmarks, longest first."""
    weak = np.nonzero(counts < MIN_MATCHES)[0]
    if len(weak) == 0:
        return ()
    breaks = np.nonzero(np.diff(stamps_s[weak]) > _LONGEST_PAUSE_S)[0] + 1
    spans = [WeakSpan(float(stamps_s[part[0]]), float(stamps_s[part[-1]]), len(part),
                      int(counts[part].max())) for part in np.split(weak, breaks)]
    return tuple(sorted(spans, key=lambda span: -span.frames))


def _advice(landmarks: Sequence[CheckedLandmark], spans: Sequence[WeakSpan],
            residuals: Residuals | None) -> list[str]:
    """Return what would improve the map."""
    advice = []
    doubled = sum(bool(one.overlaps) for one in landmarks)
    if doubled:
        advice.append(f'{doubled} landmarks lie in another one of their class: merge them, as '
                      'doubles cause false accepts')
    moved = sum(any('away: moved' in problem or 'no frame' in problem for problem in one.problems)
                for one in landmarks)
    if moved:
        advice.append(f'{moved} of {len(landmarks)} landmarks are not where the recording shows '
                      'them: build the map again')
    advice += [f'record this side: {span.frames} frames from {span.start_s:.1f} to '
               f'{span.end_s:.1f} s see at most {span.most_landmarks} landmarks'
               for span in spans[:3] if span.frames > 1]
    if residuals is not None:
        advice += residuals.advice()
    return advice
