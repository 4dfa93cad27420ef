# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The views that show a landmark best: large, whole, sharp, and from different sides."""

import threading
from collections.abc import Callable, Mapping
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import CliplocError
from cliploc_ros.offline.studio.images import Images, outlines_of
from cliploc_ros.offline.studio.landmark import Landmark
from cliploc_ros.offline.studio.recording import Recording

# A box nearer to the edge of its image may be cut off [px].
_MARGIN_PX = 3.0
# Images that are read for a landmark, at most: sharpness needs them.
_LOOKED_AT = 12
# Sides that differ [deg], and what is looked at around a box, as a share of its size.
_LEAST_ANGLE_DEG, _MARGIN = 12.0, 0.25
# Projections cost time: every n-th view of more than these is tried.
_MAX_PROJECTED = 400
_MOST_KEPT = 500


class Sighting(NamedTuple):
    """A landmark in a view."""

    view: int
    bbox_xyxy: NDArray[np.float64]  #: (4,) [px]
    is_detected: bool  #: A box of the detector; else the landmark's projection
    is_whole: bool  #: Not cut off by the edge of the image
    sharpness: float  #: Variance of the Laplacian over that of the image; 1 without images


def find_sightings(recording: Recording, images: Images | None,
                   landmarks: Mapping[str, Landmark], landmark_id: str, limit: int = 6
                   ) -> list[Sighting]:
    """Return the views that show a landmark best, the best one first.

    The detector's boxes come first. Without three of them, views that should show it join.
    """
    landmark, detections = landmarks[landmark_id], recording.detections
    found = []
    for row in recording.boxes_of(landmarks)[landmark_id]:
        view = int(np.searchsorted(detections.frame_offsets, row, side='right')) - 1
        box = detections.bboxes_xyxy[row]
        shown = _projection(recording, view, landmark)
        is_whole = (shown is not None and _is_whole(recording, view, shown, 0.0)
                    and _is_whole(recording, view, box, _MARGIN_PX))
        found.append(Sighting(view, box, True, is_whole, 1.0))
    if len(found) < 3:
        known = {one.view for one in found}
        for view in range(0, len(detections), max(1, -(-len(detections) // _MAX_PROJECTED))):
            shown = _projection(recording, view, landmark)
            if view not in known and shown is not None and _is_whole(recording, view, shown,
                                                                     _MARGIN_PX):
                found.append(Sighting(view, shown, False, True, 1.0))
    found.sort(key=lambda one: (not one.is_whole, not one.is_detected, -_size(one)))
    rays = detections.map_from_camera[:, :3, 3] - landmark.center
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    looked = _apart(found, rays, 0.5 * _LEAST_ANGLE_DEG, _LOOKED_AT)
    if images is not None:
        looked = [one._replace(sharpness=_sharpness(recording, images, one)) for one in looked]
        median = float(np.median([one.sharpness for one in looked])) if looked else 0.0
        looked.sort(key=lambda one: (
            not one.is_whole, not one.is_detected,
            -_size(one) * min(1.0, one.sharpness / max(median, 1e-9)) ** 2))
    return _apart(looked, rays, _LEAST_ANGLE_DEG, limit)


def _projection(recording: Recording, view: int, landmark: Landmark
                ) -> NDArray[np.float64] | None:
    """Return the box (4,) around a landmark's outline in a view [px]; None where it has none."""
    detections = recording.detections
    for outline in outlines_of({'': landmark}, detections.camera_of(view),
                               detections.map_from_camera[view]):
        half = np.sqrt(outline.ellipse[[2, 4]])
        return np.concatenate([outline.ellipse[:2] - half, outline.ellipse[:2] + half])
    return None


def _is_whole(recording: Recording, view: int, box: NDArray[np.float64], margin: float) -> bool:
    camera = recording.detections.camera_of(view)
    return bool(box.min() >= margin
                and (box[2:] <= np.array([camera.width, camera.height]) - margin).all())


def _size(one: Sighting) -> float:
    return float((one.bbox_xyxy[2:] - one.bbox_xyxy[:2]).prod())


def _apart(sightings: list[Sighting], rays: NDArray[np.float64], least_deg: float, limit: int
           ) -> list[Sighting]:
    """Return the first ones that lie apart from one another, filled up with the others."""
    kept: list[Sighting] = []
    near: list[Sighting] = []
    limit_cos = np.cos(np.radians(least_deg))
    for one in sightings:
        is_near = any(rays[one.view] @ rays[other.view] > limit_cos for other in kept)
        (near if is_near else kept).append(one)
    return (kept + near)[:limit]


def _sharpness(recording: Recording, images: Images, one: Sighting) -> float:
    """Return the share of fine detail in what the view shows around the landmark."""
    crop = crop_of(recording, images, one.view, one.bbox_xyxy, _MARGIN)
    if crop is None:
        return 0.0
    grey = cv2.cvtColor(crop, cv2.COLOR_RGB2GRAY)
    return float(cv2.Laplacian(grey, cv2.CV_64F).var() / max(1.0, float(grey.var())))


def crop_of(recording: Recording, images: Images, view: int, box: NDArray[np.float64],
            margin: float) -> NDArray[np.uint8] | None:
    """Return what a box (4,) [px] shows, with a margin as a share of its size; None without it."""
    detections = recording.detections
    image = images.near(float(detections.stamps_s[view]), detections.name_of(view),
                        detections.camera_of(view))
    if image is None:
        return None
    around = margin * (box[2:] - box[:2]).max()
    height, width = image.shape[:2]
    left, top = np.clip(np.floor(box[:2] - around), 0, (width - 1, height - 1)).astype(int)
    right, bottom = np.clip(np.ceil(box[2:] + around), (left + 1, top + 1), (width, height)
                            ).astype(int)
    return image[top:bottom, left:right]


class SightingFinder:
    """Finds sightings in a thread of its own, of the landmark that was asked for last first."""

    def __init__(self, recording: Recording, images: Images | None,
                 on_change: Callable[[], None]):
        self._recording, self._images, self._on_change = recording, images, on_change
        self._found: dict[str, tuple[Landmark, list[Sighting]]] = {}
        self._wanted: dict[str, Mapping[str, Landmark]] = {}
        self._condition = threading.Condition()
        self._is_stopped = False
        self._thread = threading.Thread(target=self._work, daemon=True, name='sightings')
        self._thread.start()

    def find(self, landmarks: Mapping[str, Landmark], landmark_id: str, is_moving: bool
             ) -> list[Sighting] | None:
        """Return the sightings of a landmark; None until they are found.

        Those of a landmark that is being dragged are not searched again.
        """
        with self._condition:
            known = self._found.get(landmark_id)
            if known is not None and (known[0].fields == landmarks[landmark_id].fields
                                      or is_moving):
                return known[1]
            self._wanted.pop(landmark_id, None)
            self._wanted[landmark_id] = landmarks
            self._condition.notify()
            return None if known is None else known[1]

    def stop(self) -> None:
        """End the thread."""
        with self._condition:
            self._is_stopped = True
            self._condition.notify()
        self._thread.join()

    def _work(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._wanted or self._is_stopped)
                if self._is_stopped:
                    return
                landmark_id, landmarks = self._wanted.popitem()
            try:
                found = find_sightings(self._recording, self._images, landmarks, landmark_id)
            except CliplocError:  # an image that cannot be read; the view says so
                found = []
            with self._condition:
                if len(self._found) >= _MOST_KEPT:
                    self._found.clear()
                self._found[landmark_id] = landmarks[landmark_id], found
            self._on_change()
