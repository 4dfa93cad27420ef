# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The entry point of an update: a map and a new recording of its place in, a new map out."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_embeddings import LandmarkEmbeddings
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import MappingError
from cliploc_ros.offline.mapping.options import MappingOptions
from cliploc_ros.offline.mapping.pose_noise import estimated_note
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.update.alignment import (
    MIN_CONFIRMED,
    Aligned,
    OldMap,
    align,
    known_landmarks,
)
from cliploc_ros.offline.mapping.update.identity import (
    compare_looks,
    decide_fates,
    renew_embeddings,
    why_not_comparable,
)
from cliploc_ros.offline.mapping.update.judging import (
    LEAST_VIEWS,
    Judgement,
    gather_objects,
    judge,
)
from cliploc_ros.offline.mapping.update.renewal import UpdateReport, describe, one_of_each, renew
from cliploc_ros.offline.mapping.views import check_input, make_views, map_from_cameras

# A larger offset of the recording's coordinate frame from the map's is noted [m] [deg].
_LEAST_OFFSET_M, _LEAST_OFFSET_DEG = 0.03, 1.0
# A recording that confirms a smaller share of the landmarks whose place it shows, or fewer than
# MIN_CONFIRMED, does not belong to the map. A guess.
_MIN_CONFIRMED_SHARE = 0.3
# Nor does one in which a smaller share of the landmarks' boxes fits them well. A guess, between
# blocks of TUM fr3 (0.96; 0.45 if the map is off by 10 cm on each axis) and a simulated table of
# which poses are off by 5 cm and a degree (0.28).
_MIN_WELL_SHARE = 0.35


@dataclass(frozen=True)
class UpdatedMap:
    """The result of an update: F frames, n boxes."""

    landmark_map: LandmarkMap  #: Old landmarks in their order, then new ones
    report: UpdateReport
    shown: NDArray[np.int64]  #: (n,): row of the landmark that each box shows, -1 for none
    first_new: int  #: Row of the first new landmark
    #: (F, 4, 4): the poses in the coordinate frame of the map
    map_from_camera: NDArray[np.float64]
    embeddings: LandmarkEmbeddings | None  #: Image embeddings of the new map


def update_map(old: LandmarkMap, detections: PosedDetections,
               options: MappingOptions | None = None,
               embeddings: LandmarkEmbeddings | None = None) -> UpdatedMap:
    """Update a map with a new recording of its place.

    Parameters
    ----------
    detections : PosedDetections
        Of the new recording, with poses in the coordinate frame of the map or nearly so.
    options : MappingOptions, optional
        How new landmarks are built; with pose_errors, poses are refined against the map.
    embeddings : LandmarkEmbeddings, optional
        How the old landmarks look. Ignored if another encoder looked at the recording.

    Raises
    ------
    MappingError
        The recording does not belong to this map, or no map can be made of it; the message says
        what to correct.
    """
    options = options or MappingOptions()
    given = make_views(detections, options)
    notes = check_input(detections, given, options)
    known = known_landmarks(old, detections.class_names)
    aligned = align(given, known, options)
    judged = judge(detections, aligned.views, known, options)
    loose, well = (int((known.shown(aligned.views, min_iou) >= 0).sum())
                   for min_iou in (options.association_iou, options.min_median_iou))
    _check_belongs(judged, well / max(1, loose))
    objects = gather_objects(aligned, known, judged, options)
    unlike = why_not_comparable(embeddings, detections)
    looks = None
    if unlike:
        notes.append(f'looks are not compared: {unlike}')
    elif embeddings is not None:
        looks = compare_looks(embeddings, old.landmark_ids, detections, objects)
    fates = decide_fates(known, judged, objects, looks)
    updated = renew(old, known, aligned.views, objects, fates, judged, detections.class_names)
    kept = np.setdiff1d(np.arange(len(old)), fates.missing)
    rows_of = np.full(len(objects.owners) + 1, -1, dtype=np.int64)
    has_object = fates.objects[kept] >= 0
    rows_of[fates.objects[kept][has_object]] = np.nonzero(has_object)[0]
    rows_of[fates.new] = len(kept) + np.arange(len(fates.new))
    without_doubles, shown, first_new, joined = one_of_each(
        updated, aligned.views, rows_of[objects.shown], len(kept), detections.class_names)
    notes += _notes(old, known, aligned, detections) + joined
    lists = describe(old, updated, objects, fates, judged)
    lists['new'] = tuple(one for one in lists['new']
                         if one.landmark_id in without_doubles.landmark_ids)
    report = UpdateReport(
        frames=len(detections), viewpoints=int(given.viewpoints.max()) + 1,
        offset_m=aligned.offset_m, offset_deg=aligned.offset_deg,
        pose_change_m=aligned.change_m, pose_change_deg=aligned.change_deg,
        **lists,
        left_out=tuple(sorted(judged.finds.left_out, key=lambda one: -one.support)),
        notes=tuple(notes))
    return UpdatedMap(without_doubles, report, shown, first_new, map_from_cameras(aligned.views),
                      renew_embeddings(embeddings, without_doubles.landmark_ids, detections,
                                       shown))


def _check_belongs(judged: Judgement, well_share: float) -> None:
    """Refuse a recording that shows hardly any landmark in its place, or most of them badly."""
    count, there = len(judged.is_there), int(judged.is_there.sum())
    in_view = int((judged.is_there | (judged.sight.expected[:count] >= LEAST_VIEWS)).sum())
    if (there < min(MIN_CONFIRMED, count) or there < _MIN_CONFIRMED_SHARE * in_view
            or well_share < _MIN_WELL_SHARE):
        raise MappingError(
            f'the recording does not belong to this map: of {in_view} landmarks in view, {there} '
            f'are where the map says, and {well_share:.0%} of their boxes fit; check the map, the '
            'coordinate frame of the poses and the detector, give --pose-noise if the poses have '
            'errors, or build a new map')


def _notes(old: LandmarkMap, known: OldMap, aligned: Aligned, detections: PosedDetections
           ) -> list[str]:
    """Return what the user should know of the input."""
    notes = []
    if aligned.estimated is not None:
        notes.append(estimated_note(aligned.estimated))
    if aligned.offset_m > _LEAST_OFFSET_M or aligned.offset_deg > _LEAST_OFFSET_DEG:
        notes.append(f'the poses are {aligned.offset_m * 100:.1f} cm and {aligned.offset_deg:.1f} '
                     'degrees off the map as a whole; this is corrected')
    unseen = sorted({old.class_ids[row] for row in np.nonzero(known.landmarks.classes < 0)[0]})
    if unseen:
        notes.append(f'the recording has no box of the class {", ".join(unseen[:5])}; '
                     'landmarks of it are kept: the detector may not know it')
    last_seen = max((one.last_seen or 0.0 for one in known.details), default=0.0)
    if last_seen > float(detections.stamps_s[-1]):
        notes.append(f'the recording ends at {detections.stamps_s[-1]:.0f} s, before the map was '
                     f'last seen at {last_seen:.0f} s: an older recording, or another clock')
    return notes
