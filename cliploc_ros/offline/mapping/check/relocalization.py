# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Relocalize recorded frames and simulated frames in a map.

Cross-validation: recorded frames are judged without their own view, with landmarks fitted to the
other views, and with the keyframes of the other views. One localizer gets the frames of a fold in
order, as on a robot, so that its evidence about cameras accumulates. Simulated frames have the
errors of the recording's detector; each is an independent question to a new localizer, such as
that of a robot that wakes up there.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cliploc_ros.core.geometry.transforms import SAME_BOXES, pose_error
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.relocalizer import Relocalization, Relocalizer
from cliploc_ros.offline import simulation
from cliploc_ros.offline.mapping.check.findings import Witness
from cliploc_ros.offline.mapping.evidence import MIN_MEDIAN_IOU, REACH, best_ious, is_expected
from cliploc_ros.offline.mapping.fitting import fit_landmarks, linearize_boxes
from cliploc_ros.offline.mapping.landmarks import Landmarks, group_boxes
from cliploc_ros.offline.mapping.options import CheckOptions, MappingOptions
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.views import KeyframeOptions, Views, number_viewpoints
from cliploc_ros.offline.posed_query import PosedQuery, ask
from cliploc_ros.units import NS_PER_S

_MAX_SAMPLED_FRAMES = 600
_CLUTTER_IOU = 0.1
# Frames that differ by less from the first of a view belong to this view.
_VIEW = KeyframeOptions(SAME_BOXES.distance_m, SAME_BOXES.angle_deg)

Verdict = Literal['accepted', 'refused', 'misled']
Tell = Callable[[float], None]
#: Returns the undistorted image (h, w, 3), RGB, of a recorded frame; None if it is missing.
ImageOf = Callable[[int], NDArray[np.uint8] | None]


class Fold(NamedTuple):
    """A part of a recording, and the map fitted to the other parts."""

    frames: NDArray[np.int64]  #: (k,): the frames to judge
    #: (l,): the landmarks of the whole map that the other frames suffice to fit
    rows: NDArray[np.int64]
    landmarks: Landmarks  #: These landmarks, fitted to the other frames
    training: NDArray[np.bool_]  #: (F,): these other frames


class RecordedKeyframes(NamedTuple):
    """The keyframes next to a map, and the images of the recording."""

    layer: KeyframeLayer
    image_of: ImageOf

    def elsewhere(self, pose: NDArray[np.float64]) -> KeyframeLocalizer | None:
        """Return the keyframes of other views than that of a pose; None if there are none."""
        is_other = ~SAME_BOXES.agreeing(self.layer.map_from_camera, pose[None])[:, 0]
        return KeyframeLocalizer(self.layer.view(is_other)) if is_other.any() else None

    def with_image(self, query: PosedQuery) -> PosedQuery:
        """Return the query of a recorded frame with its image, unless it is missing."""
        image = self.image_of(query.number)
        return query if image is None else replace(query, image=partial(np.asarray, image))


def make_folds(detections: PosedDetections, views: Views, witness: Witness, options: CheckOptions
               ) -> Iterator[Fold]:
    """Yield the folds of a recording, each with the map fitted to the other folds.

    Views are assigned to the folds in turn. A landmark that fits its boxes is fitted again, to the
    boxes outside the fold; it is left out if they are too few. A landmark that does not fit its
    boxes, or has none, is unchanged, as a robot would use it.
    """
    of_frames = number_viewpoints(detections, _VIEW) % options.folds
    fits = witness.gathered.median_iou >= MIN_MEDIAN_IOU
    for number in np.unique(of_frames):
        training = of_frames != number
        shown = np.where(training[views.frames], witness.shown, -1)
        is_enough = np.array([len(np.unique(views.viewpoints[views.frames[rows]]))
                              for rows in group_boxes(shown, len(fits))]
                             ) >= MappingOptions.min_viewpoints
        fitted = fit_landmarks(views, witness.landmarks, shown, among=fits & is_enough)
        kept = is_enough | ~fits
        yield Fold(np.nonzero(~training)[0], np.nonzero(kept)[0], fitted.select(kept), training)


def measure_detector(landmark_map: LandmarkMap, detections: PosedDetections, views: Views,
                     witness: Witness) -> simulation.DetectorModel:
    """Return a model of the detector of a recording, for the images of its first camera.

    The model never detects a landmark that was never detected in the recording.
    """
    landmarks, cameras = witness.landmarks, views.centers
    frames = detections.every(-(-len(detections) // _MAX_SAMPLED_FRAMES))
    reach, sightings = np.zeros(len(landmark_map)), []
    for row, rows in enumerate(group_boxes(witness.shown, len(landmark_map))):
        center, basis = landmarks.centers[row], landmarks.bases[row]
        if len(rows):
            offsets = center - cameras[views.frames[rows]]
            reach[row] = REACH * np.linalg.norm(offsets, axis=1).max()
        offsets = center - cameras
        distances = np.linalg.norm(offsets, axis=1)
        expected = frames[(is_expected(views, cameras, center, basis, reach[row])
                           & (distances > 0.0))[frames]]
        sightings.append(simulation.Sightings(offsets[expected] / distances[expected, None],
                                              np.isin(expected, views.frames[rows])))
    own = detections.frame_cameras == 0
    sides = np.diff(detections.bboxes_xyxy[own[views.frames]].reshape(-1, 2, 2), axis=1
                    ).min(axis=(1, 2))
    min_side = float(np.quantile(sides, 0.01)) if len(sides) else simulation.GUESSED_MIN_SIDE_PX
    # the boxes that no landmark explains, by frame
    is_clutter = best_ious(views, landmarks) < _CLUTTER_IOU
    clutter = []
    for frame in frames[own[frames]]:
        unknown = detections.detections_of(frame).select(np.nonzero(is_clutter[slice(
            *detections.frame_offsets[frame:frame + 2])])[0])
        clutter.append((unknown.bboxes_xyxy, unknown.class_ids))
    # the robust deviation of edges that are not open, in expected standard deviations
    linear = linearize_boxes(views, witness.shown, landmarks)
    residuals = np.abs(linear.residuals[linear.weights > 0.0])
    scale = float(np.clip(1.4826 * np.median(residuals), 0.3, 5.0)) if len(residuals) else 1.0
    return simulation.DetectorModel(
        landmark_map, detections.cameras[0], tuple(sightings), witness.gathered.seen_ratio,
        reach, scale, min_side, tuple(clutter))


@dataclass(frozen=True)
class Trial:
    """One relocalization attempt and its verdict."""

    #: 'accepted' (a right pose), 'refused', or 'misled' (a wrong pose was accepted)
    verdict: Verdict
    #: (3,): position of the camera in the map [m], and the direction in which it looks
    position: NDArray[np.float64]
    forward: NDArray[np.float64]
    #: Number of boxes, and of those that show landmarks of the map
    detections: int
    landmarks: int
    estimate: NDArray[np.float64] | None  #: (3,): position of the best pose [m]
    error_m: float | None
    reason: str  #: Of a refusal
    stamp_s: float | None = None  #: Of a recorded frame [s]
    #: Whether an accepted right pose follows from objects alone (of a recorded frame), and from
    #: keyframes alone
    by_objects: bool = False
    by_keyframes: bool = False
    result: Relocalization | None = None  #: The complete result


def simulated(detections: PosedDetections, frame: int, shown: NDArray[np.int64],
              labels: simulation.LabelModel, seed: int) -> PosedQuery:
    """Return a recorded frame as a query, with simulated, reproducible similarities.

    shown (n,) is the landmark of each box of the recording, -1 for none.
    """
    found, rows = detections.detections_of(frame), slice(*detections.frame_offsets[
        frame:frame + 2])
    return PosedQuery(frame, Observation(
        detections.camera_of(frame), found, labels.similarities(
            shown[rows], found.class_ids, found.bboxes_xyxy, np.random.default_rng([seed, frame])),
        round(detections.stamps_s[frame] * NS_PER_S), detections.name_of(frame)),
        detections.map_from_camera[frame])


def try_recording(landmark_map: LandmarkMap, detections: PosedDetections,
                  shown: NDArray[np.int64], folds: Sequence[Fold], options: CheckOptions,
                  tell: Tell, keyframes: RecordedKeyframes | None = None) -> list[Trial]:
    """Relocalize recorded frames in maps fitted to other frames; return the trials by time.

    Boxes, poses and images are those of the recording, similarities are simulated. shown (n,) is
    the landmark of each box, -1 for none. tell is called with the progress, 0 to 1. A fold has one
    localizer, and a second localizer with keyframes; each gathers its own evidence.
    """
    labels = simulation.LabelModel.of(landmark_map)
    chosen = set(sample_frames(detections, options.frames).tolist())
    taken_at = None if keyframes is None else _frames_of(keyframes.layer, detections)
    trials: list[Trial] = []
    for fold in folds:
        columns = {name: getattr(landmark_map, name).copy()
                   for name in ('centers', 'semi_axes', 'quats_xyzw')}
        for column, fitted in zip(columns.values(), (
                fold.landmarks.centers, *fold.landmarks.axes_and_quats()), strict=True):
            column[fold.rows] = fitted
        whole = replace(landmark_map, **columns)
        of_objects, of_both = Localizer(make_relocalizer(
            whole.select(fold.rows.tolist()), options)), None
        if keyframes is not None and fold.training[taken_at].any():
            # with all landmarks, since those of places that look alike refuse keyframes, too
            of_both = Localizer(make_relocalizer(whole, options), KeyframeLocalizer(
                keyframes.layer.view(fold.training[taken_at])))
        for frame in sorted(chosen.intersection(fold.frames.tolist())):
            tell((len(trials) + 1) / len(chosen))
            seen = shown[slice(*detections.frame_offsets[frame:frame + 2])]
            query = simulated(detections, frame, shown, labels, options.random_seed)
            trial = alone = try_view(of_objects, replace(query, observation=replace(
                query.observation, similarities=np.asarray(
                    query.observation.similarities)[:, fold.rows])), int((seen >= 0).sum()),
                options)
            if of_both is not None and keyframes is not None:
                trial = try_view(of_both, keyframes.with_image(query), alone.landmarks, options)
            trials.append(replace(trial, by_objects=alone.verdict == 'accepted'))
    return sorted(trials, key=lambda trial: trial.stamp_s or 0.0)


def _frames_of(layer: KeyframeLayer, detections: PosedDetections) -> NDArray[np.int64]:
    """Return the recorded frame (K,) nearest to each keyframe, by position and direction."""
    places, queries = (np.column_stack([poses[:, :3, 3], poses[:, :3, 2], poses[:, :3, 0]])
                       for poses in (detections.map_from_camera, layer.map_from_camera))
    return np.asarray(cKDTree(places).query(queries)[1])


def sample_frames(detections: PosedDetections, limit: int) -> NDArray[np.int64]:
    """Return at most `limit` frames, evenly spread over the cameras and over time."""
    count = len(detections)
    step = max(1, -(-count // limit))
    return detections.every(step, min(step // 2, count - 1))


def try_poses(model: simulation.DetectorModel, landmark_map: LandmarkMap,
              poses: NDArray[np.float64], options: CheckOptions, tell: Tell) -> list[Trial]:
    """Relocalize a simulated frame for each pose; return the trials.

    The model generates the detections, and the relocalizer knows the map; poses (k, 4, 4) are
    the true map_from_camera. tell is called with the progress, 0 to 1.
    """
    trials, relocalizer = [], make_relocalizer(landmark_map, options)
    labels = simulation.LabelModel.of(landmark_map)
    for number, pose in enumerate(poses):
        rng = np.random.default_rng([options.random_seed, number])
        detections, shown = model.detect(pose, rng)
        similarities = labels.similarities(shown, detections.class_ids, detections.bboxes_xyxy,
                                           rng)
        trials.append(replace(try_view(Localizer(relocalizer), PosedQuery(
            number, Observation(model.camera, detections, similarities), pose),
            int((shown >= 0).sum()), options), stamp_s=None))
        tell(len(trials) / len(poses))
    return trials


def count_verdicts(trials: Sequence[Trial]) -> dict[str, int]:
    """Return how many trials were accepted, refused and misled."""
    return {name: sum(trial.verdict == name for trial in trials)
            for name in ('accepted', 'refused', 'misled')}


def refused_spans(trials: Sequence[Trial]) -> Iterator[list[Trial]]:
    """Yield the runs of recorded frames without an accepted right pose, the longest first."""
    runs: list[list[Trial]] = [[]]
    for trial in trials:
        if trial.verdict == 'accepted':
            runs.append([])
        else:
            runs[-1].append(trial)
    yield from sorted((run for run in runs if run), key=len, reverse=True)


def make_relocalizer(landmark_map: LandmarkMap, options: CheckOptions) -> Relocalizer:
    """Return the relocalizer of a check."""
    k = min(options.relocalizer.k, len(landmark_map) or options.relocalizer.k)
    return Relocalizer(landmark_map, replace(options.relocalizer, k=k))


def try_view(localizer: Localizer, query: PosedQuery, landmarks: int, options: CheckOptions
             ) -> Trial:
    """Ask a localizer about a view; `landmarks` is the number of landmarks in it."""
    pose, observation = query.map_from_camera, query.observation
    up = pose[2, :3] if options.use_vertical else None  # the map's z in the camera
    result = ask(localizer, replace(query, observation=replace(observation, up_in_camera=up)))
    estimate = result.map_from_camera
    error_m = None if estimate is None else float(pose_error(estimate, pose)[0])
    verdict: Verdict = 'refused'
    if result.accepted and error_m is not None:
        verdict = 'misled' if error_m > options.wrong_m else 'accepted'
    by_points = 0.0 if result.evidence is None else result.evidence.by_points
    return Trial(verdict, pose[:3, 3], pose[:3, 2], len(observation.detections), landmarks,
                 None if estimate is None else estimate[:3, 3], error_m, result.reason,
                 observation.stamp_ns / NS_PER_S, result=result, by_keyframes=(
                     verdict == 'accepted' and by_points >= options.relocalizer.min_confidence))
