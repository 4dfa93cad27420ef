# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compare the demo's wake-ups with the ground truth, and find the matches behind each pose."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.fit.finalists import Match
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.localizer import localize_on_demand, recorded_crops
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.relocalization import Relocalization
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.datasets.intrinsics import find_camera
from cliploc_ros.datasets.tum import TumSequence, parse_stamp_ns
from cliploc_ros.demo.robot import WakeUp
from cliploc_ros.demo.truth import read_frames, true_ids
from cliploc_ros.models.clip_weights import ClipOptions
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.units import NS_PER_S

#: A pose with a greater error is wrong [m].
WRONG_M = 1.0
# A repeated search that differs by more than this has found another pose [m, deg].
_SAME_POSE = (1e-6, 1e-4)

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

    @property
    def verdict(self) -> str:
        """Return the outcome in words."""
        if not self.wake_up.accepted:
            return 'refused' if self.error is None else (
                f'refused, the best hypothesis is {self.error[0]:.2f} m off')
        if self.error is None:
            return 'accepted'
        return f'accepted, {self.error[0]:.2f} m and {self.error[1]:.1f}° from the truth'


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


class Reviewer:
    """Repeats the relocalizer's search of a frame with the same code, options and seed.

    ``landmark_of`` returns the id of an object's landmark, '' if the map lacks it. By default the
    two ids are equal.
    """

    def __init__(self, values: RelocalizerParameters, landmark_map: LandmarkMap,
                 sequence: TumSequence, landmark_of: Callable[[str], str] = str) -> None:
        self._values, self._sequence, self._landmark_of = values, sequence, landmark_of
        self._camera, _ = find_camera(None, sequence.folder)
        self._options = values.options()
        self._relocalizer = Relocalizer(landmark_map, self._options)
        self._observer = None
        if self._options.needs_similarities:
            from cliploc_ros.models.map_rows import load_encoder_for_map
            from cliploc_ros.models.observer import Observer
            self._observer = Observer(*load_encoder_for_map(
                ClipOptions(model=values.clip_model, pretrained=values.clip_pretrained),
                landmark_map, [values.map_file], values.landmark_embeddings))
        # the true boxes of each image, where the recording says them
        self._true_boxes = {
            parse_stamp_ns(frame.timestamp, 'truth.json'): frame.boxes
            for frame in read_frames(sequence.folder, least_visibility=0.0)
        } if (sequence.folder / 'truth.json').is_file() else {}

    def search(self, image_rgb: NDArray[np.uint8], detections: Detections, stamp_ns: int
               ) -> tuple[Observation, Relocalization]:
        """Return the observation of an image (h, w, 3), and the pose with all similarities."""
        if self._observer is None:
            observation = Observation(self._camera, detections, stamp_ns=stamp_ns)
        else:
            observation = self._observer.observe(image_rgb, self._camera, detections, stamp_ns)
        return observation, localize_on_demand(
            self._relocalizer, (), observation, recorded_crops(observation, self._options))[1]

    def review(self, judged: Judged) -> Review:
        """Repeat the search of a wake-up."""
        stamp_ns, camera = judged.wake_up.stamp_ns, self._camera
        path = self._sequence.image_paths[self._sequence.stamps_ns.index(stamp_ns)]
        pixels_bgr = cv2.imread(str(path), cv2.IMREAD_COLOR)
        assert pixels_bgr is not None  # the conversion to a recording has read it
        image_rgb = np.ascontiguousarray(pixels_bgr[..., ::-1], dtype=np.uint8)
        detections = judged.wake_up.detections.usable(camera.width, camera.height,
                                                      self._values.max_detections)
        observation, found = self.search(image_rgb, detections, stamp_ns)
        if found.map_from_camera is None or judged.pose is None:
            repeated = found.map_from_camera is judged.pose
        else:
            error_m, error_deg = pose_error(found.map_from_camera, judged.pose)
            repeated = error_m < _SAME_POSE[0] and error_deg < _SAME_POSE[1]
        similarities = observation.similarities
        true_boxes = self._true_boxes.get(stamp_ns)
        return Review(
            judged, image_rgb, camera, detections, found.matches if repeated else (),
            None if similarities is None else np.asarray(similarities),
            None if true_boxes is None else tuple(
                map(self._landmark_of, true_ids(detections.bboxes_xyxy, true_boxes))), repeated)
