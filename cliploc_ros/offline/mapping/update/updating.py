# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The entry point of an update: a map and a new recording of its place in, a new map out.

Landmarks are kept, refitted, moved, added and removed. A landmark keeps its id, labels and
classes. In its place, it also keeps its ellipsoid, unless the recording determines it more
precisely: then the centre is the mean of both, each weighted by its inverse variance, and the
shape is the new one. If the old ellipsoid does not fit the boxes, the object was nudged: then only
the new centre counts. An ellipsoid without position_sigma was made by hand, and is kept.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_embeddings import LandmarkEmbeddings
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import MappingError
from cliploc_ros.offline.mapping.association import ASSOCIATION_IOU, associate
from cliploc_ros.offline.mapping.building import LeftOut, left_out_lines, rounded
from cliploc_ros.offline.mapping.doubles import find_doubles
from cliploc_ros.offline.mapping.evidence import MIN_MEDIAN_IOU, Evidence, Sight, gather_evidence
from cliploc_ros.offline.mapping.joint import estimated_note
from cliploc_ros.offline.mapping.landmarks import Landmarks, landmarks_of_map, unused_ids
from cliploc_ros.offline.mapping.options import MappingOptions
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.update import alignment, identity, judging
from cliploc_ros.offline.mapping.views import Views, check_input, make_views

_ROWS_SHOWN = 40
# Least offset of the recording's coordinate frame from the map's that is reported [m] [deg].
_LEAST_OFFSET_M, _LEAST_OFFSET_DEG = 0.03, 1.0
# A recording that confirms a smaller share of the landmarks whose place it shows, or fewer than
# MIN_CONFIRMED, does not belong to the map. Chosen.
_MIN_CONFIRMED_SHARE = 0.3
# Nor does a recording in which a smaller share of the landmarks' boxes fits them well. Chosen,
# between blocks of TUM fr3 (0.96; 0.45 if the map is off by 10 cm on each axis) and a simulated
# table with poses off by 5 cm and a degree (0.28).
_MIN_WELL_SHARE = 0.35


@dataclass(frozen=True)
class UpdatedLandmark:
    """The fate of one landmark."""

    landmark_id: str
    label: str
    class_id: str
    center: tuple[float, float, float]  #: Its new position, or its old one if it is missing [m]
    distance_m: float  #: Displacement of its centre [m]
    evidence: str  #: The evidence for its fate, in words
    last_seen: float | None = None  #: [s]; None where unknown
    rivals: tuple[str, ...] = ()  #: Other landmarks that this object could be

    def line(self) -> str:
        """Return the fate as one line of text."""
        x, y, z = self.center
        text = f"{self.landmark_id} '{self.label}' at {x:.2f} {y:.2f} {z:.2f}: {self.evidence}"
        return text + (f'; or it is {", ".join(self.rivals)}: they look alike'
                       if self.rivals else '')


@dataclass(frozen=True)
class UpdateReport:
    """The result of an update: figures, the fates of landmarks, and notes."""

    #: Of the recording
    frames: int
    viewpoints: int
    #: Offset of the recording's coordinate frame, which is corrected
    offset_m: float
    offset_deg: float
    #: Root mean square change of the poses by refinement
    pose_change_m: float
    pose_change_deg: float
    confirmed: tuple[UpdatedLandmark, ...]
    moved: tuple[UpdatedLandmark, ...]
    missing: tuple[UpdatedLandmark, ...]
    new: tuple[UpdatedLandmark, ...]
    not_observed: tuple[UpdatedLandmark, ...]
    #: Those of not_observed that may be gone: hardly seen although their places were in view
    doubtful: tuple[UpdatedLandmark, ...]
    left_out: tuple[LeftOut, ...]  #: New objects that are not good enough for the map
    notes: tuple[str, ...]

    def lines(self) -> list[str]:
        """Return the report as text."""
        rows = [f'{len(self.confirmed)} confirmed, {len(self.moved)} moved, '
                f'{len(self.missing)} missing, {len(self.new)} new, '
                f'{len(self.not_observed)} not observed ({len(self.doubtful)} doubtful); '
                f'{self.frames} frames of {self.viewpoints} viewpoints']
        rows += [f'note: {note}' for note in self.notes]
        for name, found in (('moved', self.moved), ('missing', self.missing),
                            ('doubtful', self.doubtful), ('new', self.new)):
            rows += [f'{name}: {landmark.line()}' for landmark in found[:_ROWS_SHOWN]]
            if len(found) > _ROWS_SHOWN:
                rows.append(f'{name}: and {len(found) - _ROWS_SHOWN} more, see the report')
        return rows + left_out_lines(self.left_out)


@dataclass(frozen=True)
class UpdatedMap:
    """The result of an update: F frames, n boxes."""

    landmark_map: LandmarkMap  #: Old landmarks in their order, then new ones
    report: UpdateReport
    shown: NDArray[np.int64]  #: (n,): row of the landmark that each box shows, -1 for none
    first_new: int  #: Row of the first new landmark
    #: (F, 4, 4): the poses in the coordinate frame of the map
    map_from_camera: NDArray[np.float64]
    gone: Landmarks  #: Landmarks that moved or are missing, in their old places
    map_from_given: NDArray[np.float64]  #: (4, 4): the offset of the recording's coordinate frame
    embeddings: LandmarkEmbeddings | None  #: Image embeddings of the new map
    #: Landmarks that are missing now, or were before; a returning object gets its old id
    removed: LandmarkMap


def update_map(old: LandmarkMap, detections: PosedDetections,
               options: MappingOptions | None = None,
               embeddings: LandmarkEmbeddings | None = None,
               removed: LandmarkMap | None = None) -> UpdatedMap:
    """Update a map with a new recording of its place.

    Parameters
    ----------
    detections : PosedDetections
        Of the new recording, with poses in the coordinate frame of the map or nearly so.
    options : MappingOptions, optional
        How new landmarks are built; with pose_errors, poses are refined against the map.
    embeddings : LandmarkEmbeddings, optional
        Image embeddings of the old landmarks. Ignored if the recording has another encoder.
    removed : LandmarkMap, optional
        Landmarks that earlier updates removed from the map, see UpdatedMap.

    Raises
    ------
    MappingError
        The recording does not belong to this map, or no map can be made of it; the message says
        what to correct.
    """
    options = options or MappingOptions()
    given = make_views(detections)
    notes = check_input(detections, given, options.min_viewpoints)
    count = len(old)
    if removed is not None:
        old = old.with_more(removed.select([row for row, name in enumerate(removed.landmark_ids)
                                            if name not in old.landmark_ids]))
    known = alignment.known_landmarks(old, detections.class_names)
    aligned = alignment.align(given, known, options)
    judged = judging.judge(detections, aligned, known, options)
    loose, well = (int((associate(aligned.views, known.landmarks, min_iou) >= 0).sum())
                   for min_iou in (ASSOCIATION_IOU, MIN_MEDIAN_IOU))
    _check_belongs(judged, count, well / max(1, loose))
    unlike = identity.why_not_comparable(embeddings, detections)
    notes += [f'image embeddings are not compared: {unlike}'] * bool(unlike)
    looks = None if unlike or embeddings is None else identity.compare_looks(
        embeddings, old.landmark_ids, detections, judged)
    fates = identity.decide_fates(known, judged, looks, count)
    updated = _renew(known, aligned.views, judged, fates, detections.class_names)
    # the row in the new map of each object, and of none
    numbers = np.concatenate([fates.objects[fates.kept], fates.new])
    rows_of = np.full(len(judged.sight.seen) + 1, -1, dtype=np.int64)
    rows_of[numbers] = np.arange(len(numbers))
    rows_of[-1] = -1
    without_doubles, shown, first_new, joined = _one_of_each(
        updated, aligned.views, rows_of[judged.shown], len(fates.kept), detections.class_names)
    notes += _notes(known, aligned, detections) + joined + [
        f'{old.landmark_ids[row]} is back: an earlier update had removed it'
        for row in fates.kept[fates.kept >= count]]
    lists = _describe(known.map, updated, judged, fates)
    lists['new'] = tuple(landmark for landmark in lists['new']
                         if landmark.landmark_id in without_doubles.landmark_ids)
    report = UpdateReport(
        frames=len(detections), viewpoints=int(given.viewpoints.max()) + 1,
        offset_m=aligned.offset_m, offset_deg=aligned.offset_deg,
        pose_change_m=aligned.change_m, pose_change_deg=aligned.change_deg,
        **lists,
        left_out=tuple(sorted(judged.finds.without([
            find.weak if find.weak and number not in fates.objects else None
            for number, find in enumerate(judged.finds.each, len(old))], judged.sight).left_out,
            key=lambda landmark: -landmark.support)),
        notes=tuple(notes))
    return UpdatedMap(without_doubles, report, shown, first_new, aligned.views.poses,
                      known.landmarks.select(np.concatenate([fates.moved, fates.missing])),
                      aligned.map_from_given,
                      identity.renew_embeddings(embeddings, without_doubles.landmark_ids,
                                                detections, shown),
                      old.select(np.setdiff1d(np.arange(len(old)), fates.kept).tolist()))


def _check_belongs(judged: judging.Judgement, count: int, well_share: float) -> None:
    """Refuse a recording that confirms hardly any landmark, or whose boxes fit badly."""
    is_there = judged.is_there[:count]
    there = int(is_there.sum())
    in_view = int((is_there | (judged.sight.expected[:count] >= judging.LEAST_VIEWS)).sum())
    if (there < min(alignment.MIN_CONFIRMED, count) or there < _MIN_CONFIRMED_SHARE * in_view
            or well_share < _MIN_WELL_SHARE):
        raise MappingError(
            f'the recording does not belong to this map: of {in_view} landmarks in view, {there} '
            f'are where the map says, and {well_share:.0%} of their boxes fit; check map, '
            'detector and frame of the poses, give `pose_noise`, or build a new map')


def _notes(known: alignment.OldMap, aligned: alignment.Aligned, detections: PosedDetections
           ) -> list[str]:
    """Return notes for the user about the input."""
    notes = []
    if aligned.estimated is not None:
        notes.append(estimated_note(aligned.estimated))
    if aligned.offset_m > _LEAST_OFFSET_M or aligned.offset_deg > _LEAST_OFFSET_DEG:
        notes.append(f'the poses are {aligned.offset_m * 100:.1f} cm and {aligned.offset_deg:.1f} '
                     'degrees off the map; this offset is corrected')
    unseen = sorted({known.map.class_ids[row]
                     for row in np.nonzero(known.landmarks.classes < 0)[0]})
    if unseen:
        notes.append(f'the recording has no box of the class {", ".join(unseen[:5])}; '
                     'landmarks of this class are kept: the detector may not know it')
    last_seen = max((detail.last_seen or 0.0 for detail in known.map.details), default=0.0)
    if last_seen > float(detections.stamps_s[-1]):
        notes.append(f'the recording ends at {detections.stamps_s[-1]:.0f} s, before the map at '
                     f'{last_seen:.0f} s: an older recording, or another clock')
    return notes


def _renew(known: alignment.OldMap, views: Views, judged: judging.Judgement,
           fates: identity.Fates, class_names: tuple[str, ...]) -> LandmarkMap:
    """Return the new map: the old landmarks that are kept, in their order, then new ones.

    The class names are those of the recording; the views have its poses in the map.
    """
    evidence, old = gather_evidence(views, judged.landmarks, judged.shown), known.map
    centers, details = old.centers.copy(), list(old.details)
    semi_axes, quats = old.semi_axes.copy(), old.quats_xyzw.copy()
    new_axes, new_quats = judged.landmarks.axes_and_quats()
    # how well the old ellipsoids fit the boxes
    rows_of = np.full(len(judged.sight.seen) + 1, -1, dtype=np.int64)
    rows_of[fates.objects[fates.confirmed]] = fates.confirmed
    rows_of[-1] = -1
    fits = gather_evidence(views, known.landmarks, rows_of[judged.shown]).median_iou

    weights = dict.fromkeys(fates.moved.tolist(), 1.0)  # of new centres
    for row in fates.moved:
        details[row] = _in_new_place(details[row], judged.sight, evidence, fates.objects[row])
    for row in fates.confirmed.tolist():
        number, is_nudged = fates.objects[row], fits[row] < MIN_MEDIAN_IOU
        own = _looked_for(details[row], judged.sight, number)
        sigma, old_sigma = float(judged.refits.sigmas[number]), known.sigmas[row]
        # a fit to other sides of the object differs, too, but then the old ellipsoid fits
        if own.position_sigma is not None and np.isfinite(sigma) and (
                is_nudged or sigma < old_sigma):
            weights[row] = 1.0 if is_nudged else float(old_sigma**2 / (old_sigma**2 + sigma**2))
            own = replace(own, position_sigma=float(np.sqrt(weights[row])) * sigma)
        details[row] = replace(
            own, baseline_deg=max(own.baseline_deg or 0.0, float(evidence.baseline_deg[number])),
            last_seen=max(own.last_seen or 0.0, float(evidence.last_seen[number])))
    for row, weight in weights.items():
        number = fates.objects[row]
        centers[row] += weight * (judged.landmarks.centers[number] - centers[row])
        semi_axes[row], quats[row] = new_axes[number], new_quats[number]
    for row in fates.not_observed[judged.is_doubtful[fates.not_observed]].tolist():
        details[row] = _looked_for(details[row], judged.sight, row)
    names = tuple(class_names[number] for number in judged.landmarks.classes[fates.new])
    added = LandmarkMap(
        old.frame_id, unused_ids(names, old.landmark_ids), names, names,
        judged.landmarks.centers[fates.new], new_axes[fates.new], new_quats[fates.new],
        tuple(_in_new_place(judged.finds.each[number - len(old)].details, judged.sight, evidence,
                            number) for number in fates.new))
    return replace(old, centers=centers, semi_axes=semi_axes, quats_xyzw=quats, details=tuple(
        details)).select(fates.kept.tolist()).with_more(added)


def _one_of_each(updated: LandmarkMap, views: Views, shown: NDArray[np.int64], first_new: int,
                class_names: tuple[str, ...]
                ) -> tuple[LandmarkMap, NDArray[np.int64], int, list[str]]:
    """Merge the landmarks of the new map that the recording shows to be the same object.

    The older landmark keeps its id and gets the labels and classes of the other one, and the
    ellipsoid with more boxes is kept. Two old landmarks are not merged if the recording shows only
    one of them.

    Returns the map, the landmark that each box shows (n,), the row of the first new landmark, and
    notes.
    """
    into, counts = np.arange(len(updated)), np.bincount(shown[shown >= 0], minlength=len(updated))
    shapes, notes = into.copy(), []
    for first, second in find_doubles(views, landmarks_of_map(updated, class_names), shown):
        if (into[[first, second]] == (first, second)).all() and (
                second >= first_new or counts[[first, second]].all()):
            into[into == second] = first
            if counts[shapes[second]] > counts[shapes[first]]:
                shapes[first] = shapes[second]
            ids = updated.landmark_ids
            notes.append(f'{ids[second]} is the same object as {ids[first]}, which gets its '
                         'classes')
    if not notes:
        return updated, shown, first_new, notes
    joined, kept = updated.joined(into), np.unique(into)
    numbers = np.append(np.searchsorted(kept, into), -1)
    return replace(
        joined, centers=updated.centers[shapes], semi_axes=updated.semi_axes[shapes],
        quats_xyzw=updated.quats_xyzw[shapes],
        details=tuple(replace(joined.details[shape], labels=detail.labels,
                              class_weights=detail.class_weights)
                      for shape, detail in zip(shapes, joined.details, strict=True))
    ).select(kept.tolist()), numbers[shown], int(np.sum(kept < first_new)), notes


def _looked_for(details: LandmarkDetails, sight: Sight, number: int) -> LandmarkDetails:
    """Return the details of a landmark, updated by the frames that should have shown it."""
    support, expected = details.support or 0, int(sight.expected_frames[number])
    if support and details.seen_ratio:
        expected += round(support / details.seen_ratio)
    support += int(sight.seen_frames[number])
    return replace(details, support=support, seen_ratio=min(1.0, support / max(1, expected)))


def _in_new_place(details: LandmarkDetails, sight: Sight, evidence: Evidence, number: int
                  ) -> LandmarkDetails:
    """Return the details of a landmark in a new place, from the recording alone."""
    return replace(evidence.details(number, details),
                   seen_ratio=float(min(1.0, sight.seen_ratio[number])),
                   last_seen=max(0.0, float(evidence.last_seen[number])))


def _describe(old: LandmarkMap, updated: LandmarkMap, judged: judging.Judgement,
              fates: identity.Fates) -> dict[str, tuple[UpdatedLandmark, ...]]:
    """Return the lists of an UpdateReport."""
    places = dict(zip(updated.landmark_ids, updated.centers, strict=True))
    seen = judged.sight.words

    def listed(rows: NDArray[np.int64], words: Callable[[int], str]
               ) -> tuple[UpdatedLandmark, ...]:
        """Return landmarks of the old map, each with its evidence in words."""
        found = []
        for row in rows.tolist():
            center = places.get(old.landmark_ids[row], old.centers[row])
            rivals = fates.rivals.get(int(fates.objects[row]), ()) if row in fates.moved else ()
            found.append(UpdatedLandmark(
                old.landmark_ids[row], old.labels[row], old.class_ids[row], rounded(center),
                round(float(np.linalg.norm(center - old.centers[row])), 3), words(row),
                old.details[row].last_seen, tuple(old.landmark_ids[rival] for rival in rivals)))
        return tuple(found)

    def moved(row: int) -> str:
        number = fates.objects[row]
        way = float(np.linalg.norm(judged.landmarks.centers[number] - old.centers[row]))
        left = ('an object that looks different is in its old place' if judged.is_there[row]
                else f'old place {seen(row)}')
        return (f'moved by {way:.2f} m: {left}; new place seen in '
                f'{judged.sight.seen_frames[number]} of {judged.sight.expected_frames[number]}')

    return {
        'confirmed': listed(fates.confirmed, lambda row: seen(fates.objects[row])),
        'moved': listed(fates.moved, moved),
        'missing': listed(fates.missing, seen),
        'not_observed': listed(fates.not_observed, seen),
        'doubtful': listed(
            fates.not_observed[judged.is_doubtful[fates.not_observed]],
            lambda row: f'{seen(row)}: it is kept; delete it if it is gone'),
        'new': tuple(UpdatedLandmark(
            updated.landmark_ids[place], updated.labels[place], updated.class_ids[place],
            rounded(updated.centers[place]), 0.0, seen(number),
            updated.details[place].last_seen)
            for place, number in enumerate(fates.new, len(updated) - len(fates.new)))}
