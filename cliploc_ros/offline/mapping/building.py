# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The entry points of mapping: build a map of posed detections, or fit a given map to them."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import MappingError, counted
from cliploc_ros.offline.mapping import evidence, joint, triangulation
from cliploc_ros.offline.mapping.association import ASSOCIATION_IOU, associate
from cliploc_ros.offline.mapping.doubles import close_pairs, merge_doubles, resolve_doubles
from cliploc_ros.offline.mapping.fitting import fit_landmarks
from cliploc_ros.offline.mapping.landmarks import (
    Landmarks,
    group_boxes,
    landmarks_of_map,
    unused_ids,
)
from cliploc_ros.offline.mapping.odometry import link_frames
from cliploc_ros.offline.mapping.options import MappingOptions, PoseErrors
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.systematic import MountCorrection, refine_mount
from cliploc_ros.offline.mapping.views import Views, check_input, make_views, thin_out

# Landmarks are found in overlapping windows of time [s]; no pair of boxes is farther apart than
# the overlap.
_WINDOW_S, _OVERLAP_S = 90.0, 30.0
# At most this number of frames of a viewpoint are searched for new landmarks.
_FRAMES_PER_VIEWPOINT = 8
# Rounds in which boxes without a landmark are searched for new ones; rounds of association,
# merging and fitting after each search.
_DISCOVERY_ROUNDS = 2
_SETTLING_ROUNDS = 3
# Number of rebuilds of the map with refined poses; number of joint refinements of poses and
# landmarks before each rebuild, and after the last one.
_REBUILDS = 1
REFINEMENTS = 3
#: A map that explains a smaller share of the boxes of its classes is refused. Chosen: valid
#: recordings of a few frames reach .3, poses that are off by a metre .2.
LEAST_EXPLAINED = 0.2
# Boxes overlap less with a displaced landmark than with a fitted one, so the first rounds
# associate boxes from these lower IoUs on.
_FIRST_IOUS = (0.05, 0.1)
# A map is in the recording's coordinate frame if, as given, it explains at least this share of the
# boxes that it explains after fitting. On the frames of TUM fr3, maps with errors of 10 cm on each
# axis reach .70; maps that are off by 30 cm, 30 degrees or a scale of .8 reach at most .37.
_LEAST_AS_GIVEN = 0.45
# A landmark that moves farther than this, and than twice its greatest semi-axis, was fitted to
# another object. On the same frames, with errors of 15 cm on each axis, correctly fitted landmarks
# move by .49 m at most.
_MAX_MOVE_M = 0.5


#: Called with the name of a stage and the share of it that is done, 0 to 1.
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class LeftOut:
    """A landmark that is not good enough for the map."""

    class_id: str
    center: tuple[float, float, float]  #: [m]
    #: Frames that show it, and their viewpoints
    support: int
    viewpoints: int
    reason: str


class NothingFoundError(MappingError):
    """No landmark is good enough for a map; left_out has those that were found."""

    def __init__(self, message: str, left_out: tuple[LeftOut, ...]):
        super().__init__(message)
        self.left_out = left_out


def rounded(center: NDArray[np.float64]) -> tuple[float, float, float]:
    """Round a centre to millimetres, for reports."""
    x, y, z = center.round(3).tolist()
    return x, y, z


def left_out_lines(left_out: Sequence[LeftOut]) -> list[str]:
    """Describe the landmarks that are left out, by reason: one line, or none."""
    kinds = Counter(landmark.reason.partition(':')[0] for landmark in left_out)
    counts = ', '.join(f'{kind} ({count})' for kind, count in kinds.most_common())
    return [f'{counted(len(left_out), "landmark")} left out: {counts}; --report names each'
            ] if left_out else []


@dataclass(frozen=True)
class MappingReport:
    """The result of mapping: figures, the landmarks left out, and notes."""

    frames: int
    viewpoints: int
    boxes: int
    landmarks: int
    #: Share of the boxes that a landmark of their class overlaps by more than an IoU of 0.3
    explained: float
    #: Median IoU of these boxes. Both are measured on the frames that the map was fitted to.
    median_iou: float
    #: The explained share of the boxes of classes in the map, measured as in import_map
    explained_of_classes: float
    #: Root mean square by which joint refinement moved the poses
    pose_change_m: float
    pose_change_deg: float
    left_out: tuple[LeftOut, ...]  #: The landmarks with the greatest support first
    notes: tuple[str, ...]  #: Problems with the input, and what to do about them

    def lines(self) -> list[str]:
        """Return the report as text."""
        if not self.landmarks:
            return [f'no landmark from {self.frames} frames with {counted(self.boxes, "box")}: '
                    'the map consists of keyframes',
                    *(f'note: {note}' for note in self.notes), *left_out_lines(self.left_out)]
        rows = [f'{counted(self.landmarks, "landmark")} from {self.frames} frames of '
                f'{counted(self.viewpoints, "viewpoint")} with {counted(self.boxes, "box")}',
                f'boxes that landmarks fitted to them explain: {self.explained:.0%}, median IoU '
                f'{self.median_iou:.2f}']
        if self.pose_change_m > 0.0:
            rows.append(f'poses refined by {self.pose_change_m * 100:.1f} cm and '
                        f'{self.pose_change_deg:.2f} degrees (root mean square)')
        rows += [f'note: {note}' for note in self.notes]
        return rows + left_out_lines(self.left_out)


@dataclass(frozen=True)
class BuiltMap:
    """The result of mapping: F frames, n boxes."""

    landmark_map: LandmarkMap
    report: MappingReport
    shown: NDArray[np.int64]  #: (n,): row of the landmark that each box shows, -1 for none
    map_from_camera: NDArray[np.float64]  #: (F, 4, 4): the poses, refined if requested
    mount: MountCorrection | None = None  #: With refine_mount only


def build_map(detections: PosedDetections, options: MappingOptions | None = None,
              progress: Progress | None = None) -> BuiltMap:
    """Build a map from posed detections.

    MappingError: no map can be made from this input. DatasetError: its depth has another unit. The
    messages say what to correct.
    """
    options = options or MappingOptions()
    if options.refine_mount and len(detections.cameras) > 1:
        raise MappingError(f'the mounts of {len(detections.cameras)} cameras cannot be corrected '
                           'together; correct each with a map of that camera alone')
    builder = _Builder(detections, options, np.random.default_rng(options.random_seed),
                       progress or (lambda stage, share: None))
    given = make_views(detections)
    notes = check_input(detections, given, options.min_viewpoints)
    draft = builder.draft(given)
    if detections.depths is not None:
        # the draft from boxes alone gives the scale of depth
        given, depth_notes = triangulation.scaled_depths(given, detections, draft.landmarks,
                                                         draft.shown)
        notes += depth_notes
        # depth limits the deviation, not the parallax
        builder = builder._replace(options=replace(
            options, min_baseline_deg=0.0, max_position_sigma_m=max(
                options.max_position_sigma_m, triangulation.MAX_SIGMA_WITH_DEPTH_M)))
        draft = builder.draft(given)
    mount, odometry = None, detections.odom_from_camera
    if options.refine_mount:
        views = given
        for number in range(_REBUILDS + 1):
            if len(draft.landmarks.centers) == 0:
                break
            builder.tell('refining the mount', number / (_REBUILDS + 1))
            mount = refine_mount(detections, given, draft.landmarks, draft.shown, views)
            views = mount.views
            draft = builder.draft(views)
    if mount is not None:
        given, notes = mount.views, notes + mount.lines()
        odometry = None if odometry is None else odometry @ mount.given_from_corrected
    views, draft, errors, pose_notes = builder.with_poses(given, odometry, draft)
    builder.tell('done', 1.0)
    left_out = tuple(sorted(draft.left_out, key=lambda landmark: -landmark.support))
    moving = Counter(name for name in np.array(detections.class_names)[detections.classes].tolist()
                     if options.moves(name))
    if moving:
        notes.append(f'{counted(moving.total(), "box")} of {", ".join(sorted(moving))} left out: '
                     'such objects move')
    if len(draft.landmarks.centers) == 0:
        why = ('boxes of one class do not meet in space; check that poses and stamps belong to '
               'these images, that the poses are of the camera (z forward), and the intrinsics')
        if draft.left_out:
            why = (f'no landmark is good enough for a map; {left_out_lines(left_out)[0]}; move '
                   'the camera past the objects, or map images with depth')
        raise NothingFoundError(why, left_out)
    landmarks, shown = _one_of_each(views, draft.landmarks)
    quality = evidence.explained_boxes(views, landmarks, shown)
    report = MappingReport(
        len(detections), int(views.viewpoints.max()) + 1, quality.boxes, len(landmarks.centers),
        quality.explained, quality.median_iou,
        quality.explained / float(np.isin(views.classes, landmarks.classes).mean()),
        *joint.pose_changes(given, views), left_out,
        tuple(notes + pose_notes))
    landmark_map = builder.map_of(landmarks, shown, given, views, errors)
    return BuiltMap(landmark_map, report, shown, views.poses, mount)


class _Draft(NamedTuple):
    """Landmarks with the boxes that show them, and those left out."""

    landmarks: Landmarks
    shown: NDArray[np.int64]
    left_out: tuple[LeftOut, ...]


class _Builder(NamedTuple):
    """The data that all stages of building share."""

    detections: PosedDetections
    options: MappingOptions
    rng: np.random.Generator
    tell: Progress

    def draft(self, views: Views) -> _Draft:
        """Return the landmarks that the views show, with their current poses."""
        landmarks, shown = Landmarks.none(), np.full(len(views.frames), -1, dtype=np.int64)
        for number in range(_DISCOVERY_ROUNDS):
            found = self._discover(views, shown < 0)
            self.tell('fitting landmarks', number / _DISCOVERY_ROUNDS)
            landmarks, shown = self._settle(views, Landmarks.joined(landmarks, found))
        gathered = evidence.gather_evidence(views, landmarks, shown)
        reasons = evidence.reasons_against(landmarks, gathered, self.options)
        left_out = tuple(LeftOut(
            self.detections.class_names[landmarks.classes[row]], rounded(landmarks.centers[row]),
            int(gathered.support[row]), int(gathered.viewpoints[row]), reason)
            for row, reason in enumerate(reasons) if reason is not None)
        landmarks = landmarks.select(np.array([reason is None for reason in reasons],
                                              dtype=np.bool_))
        # boxes of landmarks that are left out may belong to the others
        landmarks = fit_landmarks(views, landmarks, associate(views, landmarks))
        return _Draft(landmarks, associate(views, landmarks), left_out)

    def _discover(self, views: Views, free: NDArray[np.bool_]) -> Landmarks:
        """Return landmarks that explain the free boxes, by class and window of time.

        Landmarks of one window explain boxes of the next, so that the work is proportional to the
        length of the recording.
        """
        moving = [number for number, name in enumerate(self.detections.class_names)
                  if self.options.moves(name)]
        free = free & thin_out(views, _FRAMES_PER_VIEWPOINT)[views.frames]
        found = [Landmarks.none()]
        for first, last in _windows(views.stamps_s):
            self.tell('finding landmarks', first / len(views.stamps_s))
            window = views.between(first, last)
            left = free[views.offsets[first]:views.offsets[last]].copy()
            left &= associate(window, found[-1], triangulation.SUPPORT_IOU) < 0
            found.append(Landmarks.joined(*(
                triangulation.triangulate(window, np.nonzero(left & (window.classes == number))[0],
                                          self.options.min_viewpoints, self.rng)
                for number in np.unique(window.classes[left]))))
        all_found = Landmarks.joined(*found)
        # searched before they are dropped, so that moving_classes does not change the random
        # numbers
        return all_found.select(~np.isin(all_found.classes, moving))

    def _settle(self, views: Views, landmarks: Landmarks) -> tuple[Landmarks, NDArray[np.int64]]:
        """Associate, merge and fit until landmarks and boxes agree; return both."""
        for _ in range(_SETTLING_ROUNDS):
            shown = associate(views, landmarks)
            pairs = [(first, second) for first, second, _ in close_pairs(landmarks)
                     if landmarks.classes[first] == landmarks.classes[second]]
            landmarks, shown = _keep(*merge_doubles(views, landmarks, shown, pairs), shown)
            seen = [len(np.unique(views.viewpoints[views.frames[rows]]))
                    for rows in group_boxes(shown, len(landmarks.centers))]
            landmarks = fit_landmarks(views, landmarks, shown).select(
                np.array(seen, dtype=np.int64) >= self.options.min_viewpoints)
        return landmarks, associate(views, landmarks)

    def with_poses(self, given: Views, odometry: NDArray[np.float64] | None, draft: _Draft
                   ) -> tuple[Views, _Draft, PoseErrors | None, list[str]]:
        """Return the views with refined poses, the landmarks that fit them, errors, and notes.

        Poses are refined if their errors are given, or estimated and significant. Otherwise the
        errors are None, and the poses count as exact.
        """
        views, errors, notes = given, self.options.pose_errors, list[str]()
        is_estimated = errors is None and self.options.estimate_pose_errors
        if is_estimated:
            self.tell('estimating pose errors', 0.0)
            errors = joint.significant_pose_errors(given, draft.landmarks, draft.shown)
        if errors is None or not len(draft.landmarks.centers):
            return views, draft, None, [] if odometry is None else [
                'odometry is not used: the poses are taken as they are']
        for number in range(_REBUILDS + 1):
            self.tell('refining poses', number / (_REBUILDS + 1))
            steps, link_note = None, ''
            if odometry is not None:
                steps, link_note = link_frames(given, odometry, errors,
                                               self.options.odometry_errors)
            # Errors of the poses split objects in two. Poses and parts are refined in turn until
            # the parts merge.
            for _ in range(REFINEMENTS):
                views, landmarks = joint.refine_jointly(given, views, draft.landmarks, draft.shown,
                                                        errors, steps=steps)
                landmarks, shown = self._settle(views, landmarks)
                draft = draft._replace(landmarks=landmarks, shown=shown)
            if number < _REBUILDS:
                draft = self.draft(views)
                if is_estimated:
                    # objects that were split before give a better estimate now
                    errors = joint.estimate_pose_errors(given, draft.landmarks, draft.shown,
                                                        views) or errors
        if is_estimated:
            notes.append(joint.estimated_note(errors))
        return views, draft, errors, notes + ([link_note] if link_note else [])

    def map_of(self, landmarks: Landmarks, shown: NDArray[np.int64], given: Views, views: Views,
               errors: PoseErrors | None) -> LandmarkMap:
        """Return the map of the landmarks, labelled with their class names."""
        count = len(landmarks.centers)
        gathered = evidence.gather_evidence(views, landmarks, shown)
        gathered = gathered._replace(position_sigma=np.hypot(
            gathered.position_sigma,
            joint.left_by_poses(views, np.square(joint.pose_errors(given, views)), shown, count)))
        shared = None if errors is None else joint.shared_by_neighbours(
            views, shown, count, errors)
        class_names, weights = self.detections.class_names, list[tuple[tuple[str, float], ...]]()
        for boxes in group_boxes(shown, count):  # the greatest share first
            counts = np.bincount(self.detections.classes[boxes], minlength=len(class_names))
            weights.append(tuple((class_names[number], float(counts[number] / counts.sum()))
                                 for number in np.argsort(-counts, kind='stable')
                                 if counts[number]))
        details = tuple(
            gathered.details(row, LandmarkDetails(
                class_weights=weight if len(weight) > 1 else None,
                shared_sigma=None if shared is None else float(shared[row, 0]),
                shared_sigma_deg=None if shared is None else float(shared[row, 1]),
                source=self.options.source))
            for row, weight in enumerate(weights))
        names = tuple(weight[0][0] for weight in weights)
        return LandmarkMap(self.options.frame_id, unused_ids(names), names, names,
                           landmarks.centers, *landmarks.axes_and_quats(), details)


def _windows(stamps_s: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return the first frame of each window of time, and the frame after its last."""
    windows, begin_s = [], stamps_s[0]
    while True:
        first, last = np.searchsorted(stamps_s, [begin_s, begin_s + _WINDOW_S])
        if last > first:
            windows.append((int(first), int(last)))
        if last == len(stamps_s):
            return windows
        begin_s = stamps_s[last] - _OVERLAP_S


def _keep(landmarks: Landmarks, into: NDArray[np.int64], shown: NDArray[np.int64]
          ) -> tuple[Landmarks, NDArray[np.int64]]:
    """Return the landmarks that are not merged into another, and the landmark of each box."""
    is_kept = into == np.arange(len(into))
    numbers = np.append((np.cumsum(is_kept) - 1)[into], -1)
    return landmarks.select(is_kept), numbers[shown]


def _one_of_each(views: Views, landmarks: Landmarks) -> tuple[Landmarks, NDArray[np.int64]]:
    """Return landmarks without doubles, fitted to their boxes, and the landmark of each box."""
    while True:
        shown = associate(views, landmarks)
        found, of_found = _keep(*resolve_doubles(views, landmarks, shown), shown)
        is_shown = np.bincount(of_found[of_found >= 0], minlength=len(found.centers)) > 0
        if is_shown.sum() == len(landmarks.centers):
            return landmarks, shown
        landmarks = found.select(is_shown)
        landmarks = fit_landmarks(views, landmarks, associate(views, landmarks))


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
    """Fit the chosen landmarks of a given map to the boxes of a recording that show them.

    No landmarks are added: the map gives their classes and approximate positions, and the boxes
    refine them. Ids, labels, classes and class weights are kept; a landmark that is the same
    object as others also gets theirs. Landmarks that are not chosen are unchanged, and keep the
    boxes that show them.

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
    for min_iou in (*_FIRST_IOUS, *[ASSOCIATION_IOU] * _SETTLING_ROUNDS):
        shown = associate(views, settled, min_iou)
        settled = fit_landmarks(views, settled, shown, among=chosen)
    settled, part_of = resolve_doubles(views, settled, associate(views, settled), chosen)
    is_own = part_of == np.arange(len(chosen))
    shown = associate(views, settled, among=is_own)
    gathered = evidence.gather_evidence(views, settled, shown)
    reasons = [reason if is_chosen else None for reason, is_chosen in zip(
        _reasons(views, given, settled, part_of, gathered, landmark_map), chosen, strict=True)]
    is_fitted = np.array([reason is None for reason in reasons]) & chosen
    share_known = float(known.mean())
    before = evidence.explained_boxes(views, given)
    share_before = before.explained / share_known
    share_settled = evidence.explained_boxes(views, settled.select(is_own)).explained / share_known
    if share_before < _LEAST_AS_GIVEN * share_settled:
        raise MappingError(
            f'the map does not match the boxes: it explains {share_before:.0%} of them as given, '
            f"{share_settled:.0%} after fitting; transform it to the recording's coordinate frame")
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
    gathered = evidence.gather_evidence(views, landmarks, shown)
    after = evidence.explained_boxes(views, landmarks.select(is_fitted | ~chosen))
    details = list(landmark_map.joined(part_of).details)
    for row in np.nonzero(is_fitted)[0]:
        details[row] = gathered.details(int(row), replace(
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
             gathered: evidence.Evidence, landmark_map: LandmarkMap) -> list[str | None]:
    """Return why each landmark could not be fitted; None if it was."""
    reasons = evidence.reasons_against(landmarks, gathered, MappingOptions())
    moved_m = np.linalg.norm(landmarks.centers - given.centers, axis=1)
    sizes_m = np.linalg.norm(given.bases, axis=1).max(axis=1)
    cameras = views.centers
    for row in range(len(reasons)):
        if part_of[row] != row:
            reasons[row] = f"is one object with '{landmark_map.landmark_ids[part_of[row]]}'"
        elif landmarks.classes[row] < 0:
            name = landmark_map.class_ids[row]
            reasons[row] = f"the recording has no boxes of its class, '{name}'"
        elif gathered.support[row] == 0:
            images = evidence.is_expected(views, cameras, landmarks.centers[row],
                                          landmarks.bases[row], np.inf).sum()
            reasons[row] = (f'its place is in {images} images, and no box shows it: hidden, '
                            'missed or gone' if images else 'its place is in no image')
        elif reasons[row] is None and moved_m[row] > max(_MAX_MOVE_M, 2.0 * sizes_m[row]):
            reasons[row] = f'its boxes are {moved_m[row]:.2f} m away: they show another object'
    return reasons
