# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fit the landmarks of a given map to the boxes of a recording.

No landmark is found here, and none gets another class: the map says what there is and about
where, the boxes say where exactly.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import MappingError
from cliploc_ros.mapping.association import associate, merge_pairs, pairs_of_one_class
from cliploc_ros.mapping.evidence import (
    Evidence,
    count_expected,
    explained_boxes,
    gather_evidence,
    reasons_against,
)
from cliploc_ros.mapping.fitting import fit_landmarks
from cliploc_ros.mapping.landmarks import Landmarks, group_boxes, landmarks_of_map
from cliploc_ros.mapping.options import MappingOptions
from cliploc_ros.mapping.posed_detections import PosedDetections
from cliploc_ros.mapping.views import Views, camera_centers, check_input, make_views

# Boxes overlap less with a landmark that is off than with a fitted one. The first rounds take
# them from this IoU on.
_FIRST_IOUS = (0.05, 0.1)
# A map lies in the recording's coordinate frame if, as given, it explains this share of the boxes
# that it explains after fitting. On the frames of TUM fr3, maps with errors of 10 cm on each axis
# reach .70; maps that are off by 30 cm, 30 degrees or a scale of .8 reach at most .37.
_LEAST_EXPLAINED = 0.45
# A landmark that moves farther than this, and than twice its greatest semi-axis, shows another
# object. On the same frames, with errors of 15 cm on each axis, right ones move .49 m at most.
_MAX_MOVE_M = 0.5


@dataclass(frozen=True)
class RefitMap:
    """A map fitted to a recording: L landmarks in the order of the given map."""

    landmark_map: LandmarkMap  #: All L landmarks. Those with a reason are as they were given.
    #: Why a landmark could not be fitted; None where it was fitted, or was not chosen
    reasons: tuple[str | None, ...]
    #: (L,): the landmark that a duplicate shares its object with; else its own row
    part_of: NDArray[np.int64]
    notes: tuple[str, ...]  #: What is wrong with the recording
    #: Share of the boxes of the map's classes that a landmark explains
    explained_before: float
    explained: float
    #: Median IoU of these boxes. All four are measured on the frames used for fitting.
    iou_before: float
    iou: float


class _Settled(NamedTuple):
    """L landmarks after fitting, and the landmark that each of them is part of (L,)."""

    landmarks: Landmarks
    part_of: NDArray[np.int64]


def refit_map(detections: PosedDetections, landmark_map: LandmarkMap,
              chosen: NDArray[np.bool_] | None = None, options: MappingOptions | None = None
              ) -> RefitMap:
    """Fit the chosen landmarks of a map to the boxes that show them.

    Ids, labels, classes and class weights stay. The others of the landmarks stay as they are,
    and keep the boxes that show them.

    Parameters
    ----------
    detections : PosedDetections
        In the coordinate frame of the map.
    chosen : ndarray (L,) of bool, optional
        Landmarks to fit; all without it.

    Raises
    ------
    MappingError
        Detections and map do not belong together, or the detections are unusable; the message
        says what to correct.
    """
    options = options or MappingOptions()
    views = make_views(detections, options)
    notes = check_input(detections, views, options)
    given = landmarks_of_map(landmark_map, detections.class_names)
    if chosen is None:
        chosen = np.ones(len(landmark_map), dtype=np.bool_)
    known = _check_classes(detections, landmark_map, given, views)
    settled = _settle(views, given, chosen, options)
    is_own = settled.part_of == np.arange(len(chosen))
    shown = _associate_some(views, settled.landmarks, is_own, options.association_iou)
    evidence = gather_evidence(views, settled.landmarks, shown)
    reasons = _reasons(views, given, settled, evidence, landmark_map, options)
    reasons = [reason if is_chosen else None
               for reason, is_chosen in zip(reasons, chosen, strict=True)]
    is_fitted = np.array([reason is None for reason in reasons]) & chosen
    before = _explained(views, given, known)
    settled_share, _ = _explained(views, settled.landmarks.select(is_own), known)
    if before[0] < _LEAST_EXPLAINED * settled_share:
        raise MappingError(
            f'the map does not lie where the boxes are: it explains {before[0]:.0%} of them as '
            f"given, and {settled_share:.0%} after fitting; bring it into the recording's "
            'coordinate frame and to metres first')
    if not (is_fitted | ~chosen).any():
        raise MappingError(
            f'no landmark can be fitted, the first one because: {reasons[0]}; as given, the map '
            f'explains {before[0]:.0%} of the boxes: is it in their coordinate frame?')
    # boxes of what is not fitted may belong to what is
    landmarks = _replace_rows(given, settled.landmarks, is_fitted)
    shown = _associate_some(views, landmarks, is_fitted | ~chosen, options.association_iou)
    landmarks = _fit(views, landmarks, shown, is_fitted)
    evidence = gather_evidence(views, landmarks, shown)
    after = _explained(views, landmarks.select(is_fitted | ~chosen), known)
    return RefitMap(_make_map(landmark_map, landmarks, evidence, is_fitted), tuple(reasons),
                    settled.part_of, tuple(notes), before[0], after[0], before[1], after[1])


def _check_classes(detections: PosedDetections, landmark_map: LandmarkMap, given: Landmarks,
                   views: Views) -> NDArray[np.bool_]:
    """Return which boxes are of the map's classes; refuse a recording without any."""
    known = np.isin(views.classes, given.classes)
    if not known.any():
        raise MappingError(
            "the recording has no boxes of the map's classes; map: "
            f'{", ".join(sorted(set(landmark_map.class_ids)))}; recording: '
            f'{", ".join(sorted(detections.class_names))}; rename the classes of the map')
    return known


def _settle(views: Views, given: Landmarks, chosen: NDArray[np.bool_], options: MappingOptions
            ) -> _Settled:
    """Associate, fit and merge until the chosen landmarks and their boxes agree."""
    landmarks, part_of = given, np.arange(len(chosen))
    for round_number, min_iou in enumerate(
            (*_FIRST_IOUS, *[options.association_iou] * options.settling_rounds)):
        is_own = part_of == np.arange(len(part_of))
        shown = _associate_some(views, landmarks, is_own, min_iou)
        if round_number >= len(_FIRST_IOUS):
            pairs = [pair for pair in pairs_of_one_class(landmarks, options.merge_distance)
                     if is_own[list(pair)].all() and chosen[list(pair)].all()]
            merged = merge_pairs(views, landmarks, shown, pairs, options)
            part_of = merged.into[part_of]
            rows = np.nonzero(merged.into == np.arange(len(part_of)))[0]
            shown = np.where(merged.shown < 0, -1, rows[merged.shown])
        landmarks = _fit(views, landmarks, shown, chosen)
    return _Settled(landmarks, part_of)


def _associate_some(views: Views, landmarks: Landmarks, rows: NDArray[np.bool_], min_iou: float
                    ) -> NDArray[np.int64]:
    """Return which of some landmarks each box shows, by its row among all, -1 for none."""
    shown = associate(views, landmarks.select(rows), min_iou)
    return np.where(shown < 0, -1, np.append(np.nonzero(rows)[0], -1)[shown])


def _fit(views: Views, landmarks: Landmarks, shown: NDArray[np.int64], chosen: NDArray[np.bool_]
         ) -> Landmarks:
    """Return the landmarks, the chosen ones fitted to the boxes that show them."""
    boxes = group_boxes(shown, len(landmarks.centers))
    return fit_landmarks(views, landmarks, [rows if is_chosen else rows[:0] for rows, is_chosen
                                            in zip(boxes, chosen, strict=True)])


def _replace_rows(landmarks: Landmarks, others: Landmarks, rows: NDArray[np.bool_]) -> Landmarks:
    """Return landmarks with some of their rows taken from others."""
    return Landmarks(np.where(rows[:, None], others.centers, landmarks.centers),
                     np.where(rows[:, None, None], others.bases, landmarks.bases),
                     landmarks.classes)


def _reasons(views: Views, given: Landmarks, settled: _Settled, evidence: Evidence,
             landmark_map: LandmarkMap, options: MappingOptions) -> list[str | None]:
    """Return why each landmark could not be fitted; None where it was."""
    landmarks, part_of = settled
    reasons = reasons_against(landmarks, evidence, options)
    moved_m = np.linalg.norm(landmarks.centers - given.centers, axis=1)
    sizes_m = np.linalg.norm(given.bases, axis=1).max(axis=1)
    for row in range(len(reasons)):
        if part_of[row] != row:
            reasons[row] = f"is one object with '{landmark_map.landmark_ids[part_of[row]]}'"
        elif landmarks.classes[row] < 0:
            name = landmark_map.class_ids[row]
            reasons[row] = f"the recording has no boxes of its class, '{name}'"
        elif evidence.support[row] == 0:
            reasons[row] = _why_unseen(views, landmarks, row)
        elif reasons[row] is None and moved_m[row] > max(_MAX_MOVE_M, 2.0 * sizes_m[row]):
            reasons[row] = f'its boxes are {moved_m[row]:.2f} m away: they show another object'
    return reasons


def _why_unseen(views: Views, landmarks: Landmarks, row: int) -> str:
    cameras = camera_centers(views, np.arange(len(views.rotations)))
    expected = count_expected(views, cameras, landmarks.centers[row], landmarks.bases[row],
                              np.inf)
    if expected == 0:
        return 'its place is in no image'
    return f'its place is in {expected} images, and no box shows it: hidden, missed or gone'


def _explained(views: Views, landmarks: Landmarks, known: NDArray[np.bool_]
               ) -> tuple[float, float]:
    """Return the share of the boxes of known classes that is explained, and its median IoU."""
    share, median_iou = explained_boxes(views, landmarks)
    return share / float(known.mean()), median_iou


def _make_map(given: LandmarkMap, landmarks: Landmarks, evidence: Evidence,
              is_fitted: NDArray[np.bool_]) -> LandmarkMap:
    """Return the map with the fitted landmarks and what is known of them."""
    semi_axes = np.linalg.norm(landmarks.bases, axis=1)
    rotations = landmarks.bases / semi_axes[:, None, :]
    rotations[np.linalg.det(rotations) < 0.0] *= -1.0
    quats_xyzw = Rotation.from_matrix(rotations).as_quat()
    details = list(given.details or [LandmarkDetails()] * len(given))
    for row in np.nonzero(is_fitted)[0]:
        details[row] = replace(
            details[row], position_sigma=float(evidence.position_sigma[row]),
            support=int(evidence.support[row]), seen_ratio=float(evidence.seen_ratio[row]),
            baseline_deg=float(evidence.baseline_deg[row]),
            last_seen=float(evidence.last_seen[row]))
    return replace(
        given, centers=np.where(is_fitted[:, None], landmarks.centers, given.centers),
        semi_axes=np.where(is_fitted[:, None], semi_axes, given.semi_axes),
        quats_xyzw=np.where(is_fitted[:, None], quats_xyzw, given.quats_xyzw),
        details=tuple(details))
