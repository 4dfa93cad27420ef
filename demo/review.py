# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compare the demo's wake-ups with the ground truth, and find the matches behind each pose."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.fit.finalists import Match
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import pose_error, transform_from_pose
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.query import Query
from cliploc_ros.core.relocalizer import Relocalization, Relocalizer
from cliploc_ros.models.protocols import ClipOptions, with_encoder
from cliploc_ros.offline.datasets.parsing import find_camera, parse_stamp_ns
from cliploc_ros.offline.datasets.tum import TumSequence
from cliploc_ros.ros.frame_localizer import load_keyframes
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.units import NS_PER_S
from demo.robot import WakeUp
from demo.truth import read_frames, true_ids

#: A pose with a greater error is wrong [m].
WRONG_M = 1.0
# A repeated search that differs by more than this has found another pose [m, deg].
_SAME_POSE = (1e-6, 1e-4)


@dataclass(frozen=True)
class Judged:
    """A wake-up and its ground truth."""

    number: int  #: Counted from 1
    wake_up: WakeUp
    time_s: float  #: Stamp of the image since the start of the recording [s]
    #: (4, 4): ``map_from_camera``; None if the recording lacks it
    truth: NDArray[np.float64] | None

    @property
    def pose(self) -> NDArray[np.float64] | None:
        """Return the best hypothesis (4, 4), published or not, or None."""
        return self.wake_up.hypotheses[0] if self.wake_up.hypotheses else None

    @property
    def error(self) -> tuple[float, float] | None:
        """Return the error of the best hypothesis [m, deg], or None if it is unknown."""
        if self.pose is None or self.truth is None:
            return None
        return pose_error(self.pose, self.truth)

    @property
    def is_wrong(self) -> bool:
        """Return whether the wake-up is a false accept."""
        return self.wake_up.accepted and self.error is not None and self.error[0] > WRONG_M

    @property
    def verdict(self) -> str:
        """Return the outcome in words."""
        if not self.wake_up.accepted:
            return 'refused' if self.error is None else (
                f'refused, {self.error[0]:.2f} m error of the best hypothesis')
        if self.error is None:
            return 'accepted'
        return f'accepted, {self.error[0]:.3f} m and {self.error[1]:.1f}° from the truth'


@dataclass(frozen=True)
class Review:
    """The content of a wake-up's picture."""

    judged: Judged
    image_rgb: NDArray[np.uint8]  #: (h, w, 3)
    camera: Camera
    detections: Detections  #: The n detections that the relocalizer used
    matches: tuple[Match, ...]  #: Inliers of the best hypothesis
    #: (n, L): similarity of each crop and each label; None if the method matches classes only
    similarities: NDArray[np.float32] | None
    #: The landmark of the object that each detection shows, '' if none; None without ground truth
    true_landmarks: tuple[str, ...] | None
    #: Whether the repeated search found the pose that the node sent. If not, there are no matches.
    repeated: bool
    camera_name: str = ''  #: '' for the only camera of a robot
    accepted_alone: bool = True  #: Whether a pose from the first camera alone would be accepted
    #: Reviews of the robot's other cameras, by name
    beside: Mapping[str, 'Review'] = field(default_factory=dict)


def judge(wake_up: WakeUp, number: int, sequence: TumSequence) -> Judged:
    """Return a wake-up with its ground truth."""
    return Judged(number, wake_up, (wake_up.stamp_ns - sequence.stamps_ns[0]) / NS_PER_S,
                  sequence.pose_at(wake_up.stamp_ns))


class Reviewer:
    """Repeats the relocalizer's search of a wake-up with the same code, options and seed.

    ``sequences`` and ``mounts`` have an entry for each camera; a mount is relative to the first
    camera. ``landmark_of`` returns the id of an object's landmark, '' if the map lacks it. By
    default the two ids are equal.
    """

    def __init__(self, values: RelocalizerParameters, landmark_map: LandmarkMap,
                 sequences: Mapping[str, TumSequence], mounts: Mapping[str, Sequence[float]],
                 landmark_of: Callable[[str], str] = str) -> None:
        self._values, self._sequences, self._landmark_of = values, sequences, landmark_of
        self._mounts = {name: transform_from_pose(np.array(mount[:3]), np.array(mount[3:]))
                        for name, mount in mounts.items()}
        self._options = values.options()
        self._relocalizer = Relocalizer(landmark_map, self._options)
        # its estimate of the camera's height and tilt decides how many crops a request compares
        keyframes = load_keyframes(values, landmark_map)
        self._keyframes = None if keyframes is None else keyframes.localizer
        self._localizer = Localizer(self._relocalizer, self._keyframes)
        self._observer = None
        if self._options.needs_similarities:
            from cliploc_ros.models.clip_encoder import load_encoder_for_map
            from cliploc_ros.models.observer import Observer
            self._observer = Observer(*load_encoder_for_map(
                with_encoder(ClipOptions(model=values.clip_model,
                                         pretrained=values.clip_pretrained), values.profile),
                landmark_map, [values.map_file], values.landmark_embeddings))
        # the true boxes of each image, if the recording has them
        self._true_boxes = {
            (name, parse_stamp_ns(frame.timestamp, 'truth.json')): frame.boxes
            for name, sequence in sequences.items()
            if (sequence.folder / 'truth.json').is_file()
            for frame in read_frames(sequence.folder, least_visibility=0.0)}

    def review(self, judged: Judged) -> Review:
        """Repeat the search of a wake-up."""
        seen = {name: self._observed(name, judged.wake_up) for name in self._sequences}
        first, *others = seen.values()
        found = self._search(self._localizer, [*others, first])
        if found.map_from_camera is None or judged.pose is None:
            repeated = found.map_from_camera is judged.pose
        else:
            error_m, error_deg = pose_error(found.map_from_camera, judged.pose)
            repeated = error_m < _SAME_POSE[0] and error_deg < _SAME_POSE[1]
        # the query lists the first camera last
        matches = [*found.frame_matches[-1:], *found.frame_matches[:-1]] \
            if repeated and found.solved else [()] * len(seen)
        reviews = {name: self._review(name, judged, *observed, camera_matches, repeated)
                   for (name, observed), camera_matches in zip(seen.items(), matches, strict=True)}
        first_review, *_ = reviews.values()
        return replace(first_review, beside=dict(list(reviews.items())[1:]), accepted_alone=(
            self._search(Localizer(self._relocalizer, self._keyframes), [first])
            if others else found).accepted)

    def _observed(self, name: str, wake_up: WakeUp) -> tuple[NDArray[np.uint8], Observation]:
        """Return the image (h, w, 3) of a camera, and the observation made in it."""
        sequence, stamp_ns = self._sequences[name], wake_up.stamp_ns
        camera, _ = find_camera(None, sequence.folder)
        path = sequence.image_paths[sequence.stamps_ns.index(stamp_ns)]
        pixels_bgr = cv2.imread(str(path), cv2.IMREAD_COLOR)
        assert pixels_bgr is not None  # the conversion to a recording has read it
        image_rgb = np.ascontiguousarray(pixels_bgr[..., ::-1], dtype=np.uint8)
        detections = wake_up.detections[name].usable(camera.width, camera.height,
                                                     self._values.max_detections)
        similarities = None if self._observer is None else self._observer.crops(
            image_rgb, detections.bboxes_xyxy, {}).compare(np.arange(len(detections)))
        return image_rgb, Observation(camera, detections, similarities, stamp_ns, name,
                                      odom_from_camera=self._mounts[name])

    def _search(self, localizer: Localizer,
                seen: Sequence[tuple[NDArray[np.uint8], Observation]]) -> Relocalization:
        """Localize the last camera as the relocalizer does."""
        images, observations = zip(*seen, strict=True)
        return localizer.answer(Query(observations, images, run=None))

    def _review(self, name: str, judged: Judged, image_rgb: NDArray[np.uint8],
                observation: Observation, matches: tuple[Match, ...], repeated: bool) -> Review:
        """Return the review of one camera, with the hypotheses transformed to its pose."""
        poses = tuple(pose @ self._mounts[name] for pose in judged.wake_up.hypotheses)
        detections = observation.detections
        true_boxes = self._true_boxes.get((name, judged.wake_up.stamp_ns))
        return Review(
            replace(judged, wake_up=replace(judged.wake_up, hypotheses=poses)), image_rgb,
            observation.camera, detections, matches,
            None if observation.similarities is None else np.asarray(observation.similarities),
            None if true_boxes is None else tuple(
                map(self._landmark_of, true_ids(detections.bboxes_xyxy, true_boxes))), repeated,
            name)
