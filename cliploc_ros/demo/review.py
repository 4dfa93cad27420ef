# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compare the demo's wake-ups with the ground truth, and find the matches behind each pose."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.fit.finalists import Match
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.relocalization import Relocalization
from cliploc_ros.datasets.tum import TumSequence, parse_stamp_ns
from cliploc_ros.demo.robot import WakeUp
from cliploc_ros.demo.truth import TrueBox, read_frames, true_ids
from cliploc_ros.units import NS_PER_S

#: A pose with a greater error is wrong [m].
WRONG_M = 1.0
# A repeated search that differs by more than this has found another pose [m, deg].
_SAME_POSE = (1e-6, 1e-4)

#: Makes an observation of image, camera, detections and stamp [ns].
Observe = Callable[[NDArray[np.uint8], Camera, Detections, int], Observation]
#: Okabe and Ito's blue and vermilion, which colour-blind readers can distinguish.
ACCEPTED, REFUSED = '#0072B2', '#D55E00'


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
    #: The landmark of the object that each detection shows, '' if none; None if the recording does
    #: not say it
    true_landmarks: tuple[str, ...] | None
    #: Whether the repeated search found the pose that the node sent. If not, there are no matches.
    repeated: bool


def judge(wake_up: WakeUp, number: int, sequence: TumSequence) -> Judged:
    """Return a wake-up with its ground truth."""
    return Judged(number, wake_up, (wake_up.stamp_ns - sequence.stamps_ns[0]) / NS_PER_S,
                  sequence.pose_at(wake_up.stamp_ns))


def observe_classes(image_rgb: NDArray[np.uint8], camera: Camera, detections: Detections,
                    stamp_ns: int) -> Observation:
    """Return an observation without similarities."""
    return Observation(camera, detections, stamp_ns=stamp_ns)


class Reviewer:
    """Repeats the relocalizer's search of a frame with the same code, options and seed.

    Parameters
    ----------
    relocalize : callable
        Searches the pose of an observation with all similarities.
    max_detections : int
        The relocalizer's parameter of this name.
    landmark_of : callable, optional
        Returns the id of an object's landmark, '' if the map lacks it. By default the two ids are
        equal.
    """

    def __init__(self, sequence: TumSequence, camera: Camera, observe: Observe,
                 relocalize: Callable[[Observation], Relocalization],
                 max_detections: int, landmark_of: Callable[[str], str] = str) -> None:
        self._sequence, self._camera = sequence, camera
        self._observe, self._relocalize = observe, relocalize
        self._max_detections, self._landmark_of = max_detections, landmark_of
        self._true_boxes = _read_true_boxes(sequence.folder)

    def review(self, judged: Judged) -> Review:
        """Repeat the search of a wake-up."""
        stamp = judged.wake_up.stamp_ns
        path = self._sequence.image_paths[self._sequence.stamps_ns.index(stamp)]
        pixels_bgr = cv2.imread(str(path), cv2.IMREAD_COLOR)
        assert pixels_bgr is not None  # the conversion to a recording has read it
        image_rgb = np.ascontiguousarray(pixels_bgr[..., ::-1], dtype=np.uint8)
        detections = judged.wake_up.detections.usable(
            self._camera.width, self._camera.height, self._max_detections)
        observation = self._observe(image_rgb, self._camera, detections, stamp)
        found = self._relocalize(observation)
        repeated = _same_pose(found.map_from_camera, judged.pose)
        true_boxes = self._true_boxes.get(stamp)
        return Review(judged, image_rgb, self._camera, detections,
                      found.matches if repeated else (),
                      None if observation.similarities is None
                      else np.asarray(observation.similarities),
                      None if true_boxes is None else tuple(map(
                          self._landmark_of, true_ids(detections.bboxes_xyxy, true_boxes))),
                      repeated)


def _same_pose(first: NDArray[np.float64] | None, second: NDArray[np.float64] | None) -> bool:
    if first is None or second is None:
        return first is second
    error_m, error_deg = pose_error(first, second)
    return error_m < _SAME_POSE[0] and error_deg < _SAME_POSE[1]


def _read_true_boxes(folder: Path) -> dict[int, tuple[TrueBox, ...]]:
    """Return the true boxes of each image by stamp [ns]; empty without truth.json."""
    if not (folder / 'truth.json').is_file():
        return {}
    return {parse_stamp_ns(frame.timestamp, 'truth.json'): frame.boxes
            for frame in read_frames(folder, least_visibility=0.0)}


def verdict(judged: Judged) -> str:
    """Return the outcome of a wake-up in words."""
    if not judged.wake_up.accepted:
        return 'refused' if judged.error is None else (
            f'refused, the best hypothesis is {judged.error[0]:.2f} m off')
    if judged.error is None:
        return 'accepted'
    return f'accepted, {judged.error[0]:.2f} m and {judged.error[1]:.1f}° from the truth'
