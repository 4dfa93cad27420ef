# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Expected relocalization: in recorded frames, and over a grid of camera positions."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.mapping.checking.cross_validation import Fold, fold_map
from cliploc_ros.mapping.checking.detector_model import DetectorModel
from cliploc_ros.mapping.checking.options import CheckOptions
from cliploc_ros.mapping.posed_detections import PosedDetections
from cliploc_ros.simulation.labels import LabelModel

Verdict = Literal['accepted', 'refused', 'misled']
Tell = Callable[[float], None]


class PosedObservation(NamedTuple):
    """An observation with similarities to the labels of the map, and the true pose."""

    observation: Observation
    map_from_camera: NDArray[np.float64]
    stamp_s: float


@dataclass(frozen=True)
class Trial:
    """One relocalization and its verdict."""

    #: 'accepted' (a right pose), 'refused', or 'misled' (a wrong pose was accepted)
    verdict: Verdict
    #: (3,): of the camera in the map [m], and the direction in which it looks
    position: NDArray[np.float64]
    forward: NDArray[np.float64]
    #: Boxes, and the landmarks of the map among them
    detections: int
    landmarks: int
    estimate: NDArray[np.float64] | None  #: (3,): position of the best pose [m]
    error_m: float | None
    reason: str  #: Of a refusal
    stamp_s: float | None = None  #: Of a recorded frame [s]


def try_recording(landmark_map: LandmarkMap, detections: PosedDetections,
                  shown: NDArray[np.int64], folds: Sequence[Fold], options: CheckOptions,
                  tell: Tell) -> list[Trial]:
    """Relocalize recorded frames in the map that the other frames show, in the order of time.

    Boxes and poses are the recording's, similarities are simulated.

    Parameters
    ----------
    shown : ndarray (n,) of int
        The landmark that each box shows, -1 for none.
    tell : callable
        Told the share that is done.
    """
    labels = LabelModel.of(landmark_map)
    chosen = set(sample_frames(len(detections), options.frames).tolist())
    trials, done = [], 0
    for fold in folds:
        frames = [frame for frame in fold.frames.tolist() if frame in chosen]
        if not frames:
            continue
        relocalizer = _relocalizer(fold_map(landmark_map, fold), options) if len(fold.rows) \
            else None
        for frame in frames:
            rows = slice(*detections.frame_offsets[frame:frame + 2])
            rng = np.random.default_rng([options.random_seed, frame])
            class_ids = tuple(detections.class_names[one] for one in detections.classes[rows])
            boxes, seen = detections.bboxes_xyxy[rows], shown[rows]
            pose, stamp_s = detections.map_from_camera[frame], float(detections.stamps_s[frame])
            done += 1
            tell(done / len(chosen))
            if relocalizer is None:
                trials.append(Trial('refused', pose[:3, 3], pose[:3, 2], len(boxes), 0, None,
                                    None, 'the other parts show no landmark', stamp_s))
                continue
            similarities = labels.similarities(seen, class_ids, boxes, rng)[:, fold.rows]
            trials.append(_try(
                relocalizer, detections.camera, Detections(boxes, class_ids,
                                                           detections.scores[rows]),
                similarities, pose, int((seen >= 0).sum()), options, stamp_s))
    return sorted(trials, key=lambda one: one.stamp_s or 0.0)


def sample_frames(count: int, limit: int) -> NDArray[np.int64]:
    """Return at most a limit of frames, evenly spread."""
    step = max(1, -(-count // limit))
    return np.arange(min(step // 2, count - 1), count, step)


def try_poses(model: DetectorModel, landmark_map: LandmarkMap, poses: NDArray[np.float64],
              options: CheckOptions, tell: Tell) -> list[Trial]:
    """Relocalize simulated frames, see each_pose; tell is told the share that is done."""
    trials = []
    for trial in each_pose(model, landmark_map, poses, options):
        trials.append(trial)
        tell(len(trials) / len(poses))
    return trials


def each_pose(model: DetectorModel, landmark_map: LandmarkMap, poses: NDArray[np.float64],
              options: CheckOptions) -> Iterator[Trial]:
    """Relocalize simulated frames, one at each step.

    The model has what there is to see, the map what the relocalizer knows; poses (k, 4, 4) are
    the true map_from_camera.
    """
    labels, relocalizer = LabelModel.of(landmark_map), _relocalizer(landmark_map, options)
    for number, pose in enumerate(poses):
        rng = np.random.default_rng([options.random_seed, number])
        detections, shown = model.detect(pose, rng)
        similarities = labels.similarities(shown, detections.class_ids, detections.bboxes_xyxy,
                                           rng)
        yield _try(relocalizer, model.camera, detections, similarities, pose,
                   int((shown >= 0).sum()), options)


def try_observations(landmark_map: LandmarkMap, observations: Sequence[PosedObservation],
                     options: CheckOptions, tell: Tell) -> list[Trial]:
    """Relocalize observations with recorded similarities."""
    relocalizer = _relocalizer(landmark_map, options)
    trials = []
    for number, (one, pose, stamp_s) in enumerate(observations, start=1):
        assert one.similarities is not None
        trials.append(_try(relocalizer, one.camera, one.detections, np.asarray(one.similarities),
                           pose, len(one.detections), options, stamp_s))
        tell(number / len(observations))
    return trials


def count_verdicts(trials: Sequence[Trial]) -> dict[str, int]:
    """Return how many trials were accepted, refused and misled."""
    return {name: sum(one.verdict == name for one in trials)
            for name in ('accepted', 'refused', 'misled')}


def refused_spans(trials: Sequence[Trial]) -> Iterator[list[Trial]]:
    """Yield the runs of recorded frames without an accepted right pose, the longest first."""
    runs: list[list[Trial]] = [[]]
    for one in trials:
        if one.verdict == 'accepted':
            runs.append([])
        else:
            runs[-1].append(one)
    yield from sorted((run for run in runs if run), key=len, reverse=True)


def _relocalizer(landmark_map: LandmarkMap, options: CheckOptions) -> Relocalizer:
    k = min(options.relocalizer.k, len(landmark_map))
    return Relocalizer(landmark_map, replace(options.relocalizer, k=k))


def _try(relocalizer: Relocalizer, camera: Camera, detections: Detections,
         similarities: NDArray[np.float32], map_from_camera: NDArray[np.float64], landmarks: int,
         options: CheckOptions, stamp_s: float | None = None) -> Trial:
    up = map_from_camera[2, :3] if options.use_vertical else None  # the map's z in the camera
    result = relocalizer.relocalize([Observation(camera, detections, similarities,
                                                 up_in_camera=up)])
    estimate, error_m = result.map_from_camera, None
    if estimate is not None:
        error_m = float(pose_error(estimate, map_from_camera)[0])
    verdict: Verdict = 'refused'
    if result.accepted and error_m is not None:
        verdict = 'misled' if error_m > options.wrong_m else 'accepted'
    return Trial(verdict, map_from_camera[:3, 3], map_from_camera[:3, 2], len(detections),
                 landmarks, None if estimate is None else estimate[:3, 3], error_m, result.reason,
                 stamp_s)
