# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Draw images of the recording beside advice: the best view of a landmark, or the nearest view."""

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import ellipse_bboxes, outline_points
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.mapping.association import associate
from cliploc_ros.offline.mapping.check.relocalization import Trial
from cliploc_ros.offline.mapping.check.report import Advice
from cliploc_ros.offline.mapping.landmarks import group_boxes, landmarks_of_map
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.sightings import find_sightings, outlines_in_view
from cliploc_ros.offline.mapping.views import make_views

#: Returns the undistorted image (h, w, 3), RGB, at a time [s], of a named camera; None: there is
#: none. The camera is the pinhole camera of the image.
ReadImage = Callable[[float, str, Camera], NDArray[np.uint8] | None]
# Height of a picture of a landmark, in sizes of the landmark.
_AROUND = 3.0
# Angle that makes a view as different as 1 m does [deg]; greatest difference of equal views, and
# of views that are similar enough [m].
_DEGREES_PER_M, _SAME, _MOST_DIFFERENT = 30.0, 0.1, 3.0
_WIDTH_PX, _JPEG_QUALITY = 480, 75
_BOX_RGB, _OUTLINE_RGB = (255, 255, 255), (230, 159, 0)


class Picture(NamedTuple):
    """A picture of a recorded view."""

    jpeg: bytes
    caption: str


class ViewPainter:
    """Draws views of a recording, with its boxes and the outlines of landmarks."""

    def __init__(self, landmark_map: LandmarkMap, detections: PosedDetections, read: ReadImage):
        self._map, self._detections, self._read = landmark_map, detections, read

    def of(self, advice: Advice) -> Picture | None:
        """Return the view that shows best what the advice is about; None: no view shows it."""
        if advice.landmarks:
            rows = [self._map.landmark_ids.index(landmark) for landmark in advice.landmarks]
            words = 'outlined: ' + ' and '.join(advice.landmarks)
            found = [(sighting.view, words) for sighting in find_sightings(
                self._detections, self._shown[rows[0]], self._map.centers[rows[0]],
                self._map.shapes[rows[0]], len(self._detections))]
        elif advice.view is not None:
            rows, found = [], list(self._near(advice.view))
        else:
            return None
        for frame, words in found:
            if (picture := self._draw(frame, rows)) is not None:
                seconds = self._detections.stamps_s[frame] - self._detections.stamps_s[0]
                return Picture(picture, f'{words}; image at {seconds:.0f} s')
        return None

    @cached_property
    def _shown(self) -> list[NDArray[np.int64]]:
        """Return the boxes that show each landmark."""
        return group_boxes(associate(
            make_views(self._detections),
            landmarks_of_map(self._map, self._detections.class_names)), len(self._map))

    def _near(self, view: Trial) -> Iterator[tuple[int, str]]:
        """Yield the frames near a view, the nearest first, and captions with their distance."""
        poses = self._detections.map_from_camera
        far_m = np.linalg.norm(poses[:, :3, 3] - view.position, axis=1)
        off_deg = np.degrees(np.arccos(np.clip(poses[:, :3, 2] @ view.forward, -1.0, 1.0)))
        different = far_m + off_deg / _DEGREES_PER_M
        for frame in np.argsort(different):
            if different[frame] < _MOST_DIFFERENT:
                yield int(frame), 'this view' if different[frame] < _SAME else (
                    f'a view {far_m[frame]:.1f} m and {off_deg[frame]:.0f} degrees away')

    def _boxes(self, frame: int) -> NDArray[np.float64]:
        return self._detections.bboxes_xyxy[slice(
            *self._detections.frame_offsets[frame:frame + 2])]

    def _draw(self, frame: int, rows: list[int]) -> bytes | None:
        """Return a JPEG of a frame with its boxes and outlines of landmarks; None: no image."""
        camera = self._detections.camera_of(frame)
        image = self._read(float(self._detections.stamps_s[frame]),
                           self._detections.name_of(frame), camera)
        if image is None:
            return None
        outlines = outlines_in_view(self._detections, frame, self._map.centers[rows],
                                    self._map.shapes[rows])
        corner, size = np.zeros(2), np.array([camera.width, camera.height], dtype=np.float64)
        if rows:
            # crop the image, so that a small landmark is visible
            left, top, right, bottom = ellipse_bboxes(outlines[:1])[0]
            part = float(np.clip(_AROUND * max(right - left, bottom - top) / size[1], 0.3, 1.0))
            corner = np.clip(np.array([left + right, top + bottom]) / 2 - part * size / 2, 0.0,
                             (1.0 - part) * size).round()
            size = part * size
        scale = _WIDTH_PX / size[0]
        (x, y), (width, height) = corner.astype(int).tolist(), size.astype(int).tolist()
        small = cv2.resize(np.ascontiguousarray(image[y:y + height, x:x + width]), None, fx=scale,
                           fy=scale, interpolation=cv2.INTER_AREA)
        for box in (self._boxes(frame) - np.tile(corner, 2)) * scale:
            left, top, right, bottom = np.rint(box).astype(int).tolist()
            cv2.rectangle(small, (left, top), (right, bottom), _BOX_RGB, 1, cv2.LINE_AA)
        for outline in outlines:
            if np.isfinite(outline).all():
                points = np.rint((outline_points(outline) - corner) * scale).clip(-9999, 9999)
                cv2.polylines(small, [points.astype(np.int32)], True, _OUTLINE_RGB, 4, cv2.LINE_AA)
        return cv2.imencode('.jpg', small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
                            )[1].tobytes()
