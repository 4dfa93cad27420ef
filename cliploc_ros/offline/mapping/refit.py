# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fit the landmarks of a given map to the boxes of a recording.

No landmarks are added: the map gives their classes and approximate positions, and the boxes refine
them.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import MappingError
from cliploc_ros.offline.mapping.association import ASSOCIATION_IOU, associate
from cliploc_ros.offline.mapping.building import SETTLING_ROUNDS
from cliploc_ros.offline.mapping.doubles import resolve_doubles
from cliploc_ros.offline.mapping.evidence import (
    Evidence,
    explained_boxes,
    gather_evidence,
    is_expected,
    reasons_against,
)
from cliploc_ros.offline.mapping.fitting import fit_landmarks
from cliploc_ros.offline.mapping.landmarks import Landmarks, landmarks_of_map
from cliploc_ros.offline.mapping.options import MappingOptions
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.views import Views, check_input, make_views

# Boxes overlap less with a displaced landmark than with a fitted one, so the first rounds
# associate boxes from these lower IoUs on.
_FIRST_IOUS = (0.05, 0.1)
#: A map is in the recording's coordinate frame if, as given, it explains at least this share
#: of the boxes that it explains after fitting. On the frames of TUM fr3, maps with errors of 10 cm
#: on each axis
# reach .70; maps that are off by 30 cm, 30 degrees or a scale of .8 reach at most .37.
LEAST_EXPLAINED = 0.45
# A landmark that moves farther than this, and than twice its greatest semi-axis, was fitted to
# another object. On the same frames, with errors of 15 cm on each axis, correctly fitted landmarks
# move by .49 m at most.
_MAX_MOVE_M = 0.5


@dataclass(frozen=True)
class RefitMap:
    """A map fitted to a recording: L landmarks in the order of the given map."""

    landmark_map: LandmarkMap  #: All L landmarks; those with a reason are unchanged
    #: Why a landmark could not be fitted; None if it was fitted, or was not chosen
    reasons: tuple[str | None, ...]
    #: (L,): the landmark that is the same object as each one; its own row if there is none
    part_of: NDArray[np.int64]
    notes: tuple[str, ...]  #: Problems with the recording
    #: Share of the boxes of the map's classes that a landmark explains
    explained_before: float
    explained: float
    #: Median IoU of these boxes. All four are measured on the frames used for fitting.
    iou_before: float
    iou: float


def refit_map(detections: PosedDetections, landmark_map: LandmarkMap,
              chosen: NDArray[np.bool_] | None = None) -> RefitMap:
    """Fit the chosen landmarks of a map to the boxes that show them.

    Ids, labels, classes and class weights are kept; a landmark that is the same object as others
    also gets theirs. Landmarks that are not chosen are unchanged, and keep the boxes that show
    them.

    Parameters
    ----------
    detections : PosedDetections
        In the coordinate frame of the map.
    chosen : ndarray (L,) of bool, optional
        Landmarks to fit; default: all.

    Raises
    ------
    MappingError
        Detections and map do not belong together, or the detections are unusable; the message
        says what to correct.
    """
    views = make_views(detections)
    notes = check_input(detections, views)
    given = landmarks_of_map(landmark_map, detections.class_names)
    chosen = np.ones(len(landmark_map), dtype=np.bool_) if chosen is None else chosen
    known = np.isin(views.classes, given.classes)
    if not known.any():
        raise MappingError(
            "the recording has no boxes of the map's classes; map: "
            f'{", ".join(sorted(set(landmark_map.class_ids)))}; recording: '
            f'{", ".join(sorted(detections.class_names))}; rename the classes of the map')
    settled = given
    for min_iou in (*_FIRST_IOUS, *[ASSOCIATION_IOU] * SETTLING_ROUNDS):
        shown = associate(views, settled, min_iou)
        settled = fit_landmarks(views, settled, shown, among=chosen)
    settled, part_of = resolve_doubles(views, settled, associate(views, settled), chosen)
    is_own = part_of == np.arange(len(chosen))
    shown = associate(views, settled, among=is_own)
    evidence = gather_evidence(views, settled, shown)
    reasons = [reason if is_chosen else None for reason, is_chosen in zip(
        _reasons(views, given, settled, part_of, evidence, landmark_map), chosen, strict=True)]
    is_fitted = np.array([reason is None for reason in reasons]) & chosen
    share_known = float(known.mean())
    before = explained_boxes(views, given)
    share_before = before.explained / share_known
    share_settled = explained_boxes(views, settled.select(is_own)).explained / share_known
    if share_before < LEAST_EXPLAINED * share_settled:
        raise MappingError(
            f'the map does not match the boxes: it explains {share_before:.0%} of them as given, '
            f"and {share_settled:.0%} after fitting; transform it to the recording's coordinate "
            'frame, and to metres, first')
    if not (is_fitted | ~chosen).any():
        raise MappingError(
            f'no landmark can be fitted; for the first one, {reasons[0]}; as given, the map '
            f'explains {share_before:.0%} of the boxes: check its coordinate frame')
    # boxes of landmarks that were not fitted may belong to fitted ones
    landmarks = settled._replace(
        centers=np.where(is_fitted[:, None], settled.centers, given.centers),
        bases=np.where(is_fitted[:, None, None], settled.bases, given.bases))
    shown = associate(views, landmarks, among=is_fitted | ~chosen)
    landmarks = fit_landmarks(views, landmarks, shown, among=is_fitted)
    evidence = gather_evidence(views, landmarks, shown)
    after = explained_boxes(views, landmarks.select(is_fitted | ~chosen))
    details = list(landmark_map.joined(part_of).details)
    for row in np.nonzero(is_fitted)[0]:
        details[row] = evidence.details(int(row), replace(
            details[row], shared_sigma=None, shared_sigma_deg=None))
    semi_axes, quats_xyzw = landmarks.axes_and_quats()
    fitted = is_fitted[:, None]
    return RefitMap(
        replace(landmark_map, centers=np.where(fitted, landmarks.centers, landmark_map.centers),
                semi_axes=np.where(fitted, semi_axes, landmark_map.semi_axes),
                quats_xyzw=np.where(fitted, quats_xyzw, landmark_map.quats_xyzw),
                details=tuple(details)),
        tuple(reasons), part_of, tuple(notes), share_before, after.explained / share_known,
        before.median_iou, after.median_iou)


def _reasons(views: Views, given: Landmarks, landmarks: Landmarks, part_of: NDArray[np.int64],
             evidence: Evidence, landmark_map: LandmarkMap) -> list[str | None]:
    """Return why each landmark could not be fitted; None if it was."""
    reasons = reasons_against(landmarks, evidence, MappingOptions())
    moved_m = np.linalg.norm(landmarks.centers - given.centers, axis=1)
    sizes_m = np.linalg.norm(given.bases, axis=1).max(axis=1)
    cameras = views.centers
    for row in range(len(reasons)):
        if part_of[row] != row:
            reasons[row] = f"is one object with '{landmark_map.landmark_ids[part_of[row]]}'"
        elif landmarks.classes[row] < 0:
            name = landmark_map.class_ids[row]
            reasons[row] = f"the recording has no boxes of its class, '{name}'"
        elif evidence.support[row] == 0:
            images = is_expected(views, cameras, landmarks.centers[row], landmarks.bases[row],
                                 np.inf).sum()
            reasons[row] = (f'its place is in {images} images, and no box shows it: hidden, '
                            'missed or gone' if images else 'its place is in no image')
        elif reasons[row] is None and moved_m[row] > max(_MAX_MOVE_M, 2.0 * sizes_m[row]):
            reasons[row] = f'its boxes are {moved_m[row]:.2f} m away: they show another object'
    return reasons
