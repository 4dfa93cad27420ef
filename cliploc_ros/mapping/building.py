# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What mapping says about its result: what it found, what it left out and why."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import MappingError
from cliploc_ros.mapping.association import associate, merge_classes, merge_duplicates
from cliploc_ros.mapping.evidence import (
    Evidence,
    explained_boxes,
    gather_evidence,
    reasons_against,
)
from cliploc_ros.mapping.fitting import fit_landmarks
from cliploc_ros.mapping.joint import pose_errors, refine_jointly
from cliploc_ros.mapping.landmarks import Landmarks, group_boxes, join_landmarks, no_landmarks
from cliploc_ros.mapping.mount import MountCorrection, refine_mount
from cliploc_ros.mapping.odometry import Steps, link_frames
from cliploc_ros.mapping.options import MappingOptions, PoseErrors
from cliploc_ros.mapping.pose_noise import (
    estimate_pose_errors,
    left_by_poses,
    shared_by_neighbours,
    significant_pose_errors,
)
from cliploc_ros.mapping.posed_detections import PosedDetections
from cliploc_ros.mapping.triangulation import (
    SUPPORT_IOU,
    add_depths,
    correct_scale,
    depth_scale,
    options_with_depth,
    triangulate,
)
from cliploc_ros.mapping.views import Views, check_input, make_views, map_from_cameras, thin_out

_REASONS_SHOWN = 10
# Landmarks are found in windows of time that overlap: no pair of boxes is farther apart.
_WINDOW_S, _OVERLAP_S = 90.0, 30.0


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


def describe_left_out(detections: PosedDetections, landmarks: Landmarks, evidence: Evidence,
                      reasons: Sequence[str]) -> tuple[LeftOut, ...]:
    """Return what was left out, that with the greatest support first."""
    x_y_z = landmarks.centers.round(3).tolist()
    return tuple(
        LeftOut(detections.class_names[landmarks.classes[row]], tuple(x_y_z[row]),
                int(evidence.support[row]), int(evidence.viewpoints[row]), reasons[row])
        for row in np.argsort(-evidence.support, kind='stable'))


class NothingFoundError(MappingError):
    """The boxes show no landmark that is good enough for a map."""


#: Told the name of a stage and the share of it that is done.
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class BuiltMap:
    """The result of mapping: F frames, n boxes."""

    landmark_map: LandmarkMap
    report: MappingReport
    shown: NDArray[np.int64]  #: (n,): row of the landmark that each box shows, -1 for none
    map_from_camera: NDArray[np.float64]  #: (F, 4, 4): the poses, refined where that was asked for
    mount: MountCorrection | None = None  #: Where a correction was asked for


def build_map(detections: PosedDetections, options: MappingOptions | None = None,
              progress: Progress | None = None) -> BuiltMap:
    """Build a map from posed detections.

    Parameters
    ----------
    progress : callable, optional
        Called with the name of a stage and the share of it that is done, 0 to 1.

    Raises
    ------
    MappingError
        No map can be made of this input; the message says what to correct.
    """
    options = options or MappingOptions()
    tell = progress or (lambda stage, share: None)
    given = make_views(detections, options)
    notes = check_input(detections, given, options)
    rng = np.random.default_rng(options.random_seed)
    if detections.depths is not None:
        given, options, depth_notes = _with_depths(detections, given, options, rng, tell)
        notes += depth_notes
    draft = _draft(given, options, rng, tell)
    mount, odometry = None, detections.odom_from_camera
    if options.refine_mount:
        mount, draft = _with_mount(given, draft, options, rng, tell)
        given, notes = mount.views, notes + mount.lines()
        odometry = None if odometry is None else odometry @ mount.given_from_corrected
    views, draft, errors, pose_notes = _with_poses(given, odometry, draft, options, rng, tell)
    notes += pose_notes
    tell('done', 1.0)
    if len(draft.landmarks.centers) == 0:
        raise NothingFoundError(_nothing_found(draft))
    return replace(_finish(detections, given, views, draft, errors, options, notes),
                   mount=mount)


def _with_depths(detections: PosedDetections, views: Views, options: MappingOptions,
                 rng: np.random.Generator, tell: Progress
                 ) -> tuple[Views, MappingOptions, list[str]]:
    """Return views with depth of the right scale, options that rely on it, and notes."""
    draft = _draft(views, options, rng, tell)  # of boxes alone
    evidence = gather_evidence(views, draft.landmarks, draft.shown)
    with_depths = add_depths(views, detections)
    scale = depth_scale(with_depths, draft.landmarks, draft.shown, evidence.baseline_deg)
    with_depths, notes = correct_scale(with_depths, detections, scale)
    return with_depths, options_with_depth(options), notes


def _with_mount(given: Views, draft: '_Draft', options: MappingOptions,
                rng: np.random.Generator, tell: Progress) -> tuple[MountCorrection, '_Draft']:
    """Return the correction of the mount, and a draft of the views with the correction."""
    views = given
    for number in range(options.rebuilds + 1):
        tell('refining the mount', number / (options.rebuilds + 1))
        found = refine_mount(given, draft.landmarks, draft.shown, views)
        views = found.views
        draft = _draft(views, options, rng, tell)
    return found, draft


def _with_poses(given: Views, odometry: NDArray[np.float64] | None, draft: '_Draft',
                options: MappingOptions, rng: np.random.Generator, tell: Progress
                ) -> tuple[Views, '_Draft', PoseErrors | None, list[str]]:
    """Return the views with refined poses, the landmarks that fit them, errors, and notes.

    Poses are refined where their errors are given, or estimated and significant. None: they are
    taken as exact.
    """
    views, errors, notes = given, options.pose_errors, list[str]()
    is_estimated = errors is None and options.estimate_pose_errors
    if is_estimated:
        tell('estimating pose errors', 0.0)
        errors = significant_pose_errors(given, draft.landmarks, draft.shown)
    if errors is None:
        return views, draft, None, [] if odometry is None else [
            'odometry is not used: the poses are taken as they are']
    steps, link_notes = _links(given, odometry, errors, options)
    for number in range(options.rebuilds):
        tell('refining poses', number / options.rebuilds)
        views, draft = _refine(given, views, draft, errors, steps, options)
        draft = _draft(views, options, rng, tell)
        if is_estimated:
            # objects that were split before tell more now
            errors = estimate_pose_errors(given, draft.landmarks, draft.shown, views) or errors
            steps, link_notes = _links(given, odometry, errors, options)
    if is_estimated:
        notes.append(f'poses are off by about {100 * errors.sigma_m:.1f} cm and '
                     f'{errors.sigma_deg:.1f} degrees on each axis for {errors.correlation_s:.1f} '
                     's, estimated from the boxes; refined')
    views, draft = _refine(given, views, draft, errors, steps, options)
    return views, draft, errors, notes + link_notes


def _links(given: Views, odometry: NDArray[np.float64] | None, errors: PoseErrors,
           options: MappingOptions) -> tuple[Steps | None, list[str]]:
    """Return the steps of odometry between frames, and notes on them."""
    if odometry is None:
        return None, []
    steps, note = link_frames(given, odometry, errors, options.odometry_errors)
    return steps, [note]


class _Draft(NamedTuple):
    """Landmarks with the boxes that show them, and what did not become one."""

    landmarks: Landmarks
    shown: NDArray[np.int64]
    left_out: Landmarks
    reasons: list[str]
    evidence_against: Evidence


def _draft(views: Views, options: MappingOptions, rng: np.random.Generator, tell: Progress
           ) -> _Draft:
    """Return the landmarks that the views show, for the poses that they have."""
    landmarks = no_landmarks()
    for number in range(options.discovery_rounds):
        free = associate(views, landmarks, options.association_iou) < 0
        landmarks = join_landmarks(landmarks, _discover(views, free, options, rng,
                                                        tell))
        tell('fitting landmarks', number / options.discovery_rounds)
        landmarks = _settle(views, landmarks, options)
    evidence = gather_evidence(views, landmarks,
                               associate(views, landmarks, options.association_iou))
    reasons = reasons_against(landmarks, evidence, options)
    kept = np.array([reason is None for reason in reasons], dtype=np.bool_)
    landmarks, left_out = landmarks.select(kept), landmarks.select(~kept)
    # boxes of what is left out may belong to what stays
    shown = associate(views, landmarks, options.association_iou)
    landmarks = fit_landmarks(views, landmarks, group_boxes(shown, len(landmarks.centers)))
    return _Draft(landmarks, associate(views, landmarks, options.association_iou), left_out,
                  [reason for reason in reasons if reason is not None],
                  evidence.select(~kept))


def _refine(given: Views, views: Views, draft: _Draft, errors: PoseErrors,
            steps: Steps | None, options: MappingOptions) -> tuple[Views, _Draft]:
    """Return the views with refined poses, and the landmarks that fit them.

    Errors of the poses split objects in two. Poses and parts move towards each other in turns,
    until the parts merge.
    """
    landmarks, shown = draft.landmarks, draft.shown
    for _ in range(options.refinements):
        views, landmarks = refine_jointly(given, views, landmarks, shown, errors, steps=steps)
        landmarks = _settle(views, landmarks, options)
        shown = associate(views, landmarks, options.association_iou)
    return views, draft._replace(landmarks=landmarks, shown=shown)


def _discover(views: Views, free: NDArray[np.bool_], options: MappingOptions,
              rng: np.random.Generator, tell: Progress) -> Landmarks:
    """Return landmarks that explain the free boxes, class by class and minute by minute.

    What a window of time has found explains boxes of the next one, so that the work grows with
    the length of the recording only.
    """
    free = free & thin_out(views, options.frames_per_viewpoint)[views.frames]
    found = [no_landmarks()]
    for first, last in _windows(views.stamps_s):
        tell('finding landmarks', first / len(views.stamps_s))
        window = views.between(first, last)
        left = free[views.offsets[first]:views.offsets[last]].copy()
        left &= associate(window, found[-1], SUPPORT_IOU) < 0
        found.append(join_landmarks(*(
            triangulate(window, np.nonzero(left & (window.classes == number))[0], options, rng)
            for number in np.unique(window.classes[left]))))
    return join_landmarks(*found)


def _windows(stamps_s: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return the first frame of each window of time, and the one after its last."""
    windows, begin_s = [], stamps_s[0]
    while True:
        first, last = np.searchsorted(stamps_s, [begin_s, begin_s + _WINDOW_S])
        if last > first:
            windows.append((int(first), int(last)))
        if last == len(stamps_s):
            return windows
        begin_s = stamps_s[last] - _OVERLAP_S


def _settle(views: Views, landmarks: Landmarks, options: MappingOptions) -> Landmarks:
    """Associate, merge and fit until landmarks and boxes agree."""
    for _ in range(options.settling_rounds):
        shown = associate(views, landmarks, options.association_iou)
        landmarks, shown = merge_duplicates(views, landmarks, shown, options)
        boxes = group_boxes(shown, len(landmarks.centers))
        seen = [len(np.unique(views.viewpoints[views.frames[rows]])) >= options.min_viewpoints
                for rows in boxes]
        landmarks = fit_landmarks(views, landmarks, boxes).select(np.array(seen, dtype=np.bool_))
    return landmarks


def _nothing_found(draft: _Draft) -> str:
    if draft.reasons:
        return (f'no landmark is good enough for a map; {len(draft.reasons)} were left out, the '
                f'first one because: {draft.reasons[0]}')
    return ('no boxes of one class meet in space; check that poses and stamps belong to these '
            'images, that the poses are of the camera (z forward), and the intrinsics')


def _finish(detections: PosedDetections, given: Views, views: Views, draft: _Draft,
            errors: PoseErrors | None, options: MappingOptions, notes: list[str]) -> BuiltMap:
    landmarks, shown = merge_classes(views, draft.landmarks, draft.shown, options)
    evidence = gather_evidence(views, landmarks, shown)
    explained, median_iou = explained_boxes(views, landmarks, shown)
    changes = np.square(pose_errors(given, views))
    report = MappingReport(
        frames=len(detections), viewpoints=int(views.viewpoints[-1]) + 1,
        boxes=len(detections.classes), landmarks=len(landmarks.centers),
        explained=explained, median_iou=median_iou,
        pose_change_m=float(np.sqrt(changes[:, :3].sum(axis=1).mean())),
        pose_change_deg=float(np.degrees(np.sqrt(changes[:, 3:].sum(axis=1).mean()))),
        left_out=describe_left_out(detections, draft.left_out, draft.evidence_against,
                                   draft.reasons),
        notes=tuple(notes))
    evidence = evidence._replace(position_sigma=np.hypot(
        evidence.position_sigma, left_by_poses(views, changes, shown, len(landmarks.centers))))
    shared = None if errors is None else shared_by_neighbours(views, shown,
                                                              len(landmarks.centers), errors)
    return BuiltMap(_make_map(detections, landmarks, shown, evidence, shared, options), report,
                    shown, map_from_cameras(views))


def _make_map(detections: PosedDetections, landmarks: Landmarks, shown: NDArray[np.int64],
              evidence: Evidence, shared: NDArray[np.float64] | None,
              options: MappingOptions) -> LandmarkMap:
    """Return landmarks as a map; labels are the class names."""
    names = tuple(detections.class_names[number] for number in landmarks.classes)
    semi_axes = np.linalg.norm(landmarks.bases, axis=1)
    rotations = landmarks.bases / semi_axes[:, None, :]
    rotations[np.linalg.det(rotations) < 0.0] *= -1.0
    boxes_of = group_boxes(shown, len(names))
    details = tuple(
        LandmarkDetails(
            class_weights=_class_weights(detections, boxes_of[row]),
            position_sigma=float(evidence.position_sigma[row]),
            shared_sigma=None if shared is None else float(shared[row, 0]),
            shared_sigma_deg=None if shared is None else float(shared[row, 1]),
            support=int(evidence.support[row]), seen_ratio=float(evidence.seen_ratio[row]),
            baseline_deg=float(evidence.baseline_deg[row]),
            last_seen=float(evidence.last_seen[row]), source=options.source)
        for row in range(len(names)))
    # A unique id for each landmark: its class and a number.
    counts: dict[str, int] = {}
    ids = []
    for name in names:
        word = ''.join(char if char.isalnum() else '_' for char in name)
        counts[word] = counts.get(word, 0) + 1
        ids.append(f'{word}_{counts[word]}')
    landmark_ids = tuple(ids)
    return LandmarkMap(options.frame_id, landmark_ids, names, names, landmarks.centers,
                       semi_axes, Rotation.from_matrix(rotations).as_quat(), details)


def _class_weights(detections: PosedDetections, rows: NDArray[np.int64]
                   ) -> tuple[tuple[str, float], ...] | None:
    """Return the classes of some boxes with their shares, the greatest first; None for one."""
    counts = np.bincount(detections.classes[rows], minlength=len(detections.class_names))
    if np.count_nonzero(counts) < 2:
        return None
    return tuple((detections.class_names[number], float(counts[number] / counts.sum()))
                 for number in np.argsort(-counts, kind='stable') if counts[number])
