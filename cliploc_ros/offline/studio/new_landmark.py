# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A landmark that a person makes of boxes: one box of the object in each of some views.

The boxes of the other views show where the object lies in a view without one: on the ray of one
box, or where the ellipsoid that fits two or more projects to.
"""

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.offline.mapping.fitting import Fit
from cliploc_ros.offline.studio import edits
from cliploc_ros.offline.studio.document import Document
from cliploc_ros.offline.studio.edits import EditError
from cliploc_ros.offline.studio.images import Pixel, box_at
from cliploc_ros.offline.studio.recording import LEAST_BOXES, MIN_BOX_PX, Recording, fit_boxes

Box = tuple[float, float, float, float]
# The object of one box may lie between these distances [m].
_DEPTHS_M = np.geomspace(0.4, 12.0, 24)
# A drawn box that overlaps a detector's box by more than this has its class.
_SAME_IOU = 0.5
# A view of the next box is this far from those of the other ones, if there is one [deg].
_GOOD_ANGLE_DEG = 45.0
# Asking again means that the last view did not help: views this near to it are skipped [deg].
_OTHER_ANGLE_DEG = 10.0


class NewLandmark:
    """The boxes by view, the class that they suggest, and the ellipsoid that fits them."""

    def __init__(self, document: Document, recording: Recording):
        self._document, self._recording = document, recording
        self.boxes: dict[int, Box] = {}
        #: Of the detector's boxes that were taken or drawn over; '' for none
        self.class_id = ''
        self._fitted: tuple[dict[int, Box], Fit | None, str] = ({}, None, '')
        # the next views since the last box
        self._offered: list[int] = []

    def draw(self, view: int, corner: Pixel, other: Pixel) -> str:
        """Put a box into a view, between two opposite corners (2,) [px]."""
        camera = self._recording.detections.camera_of(view)
        size = np.array([camera.width, camera.height], dtype=np.float64)
        low, high = (np.clip(select(np.asarray(corner), np.asarray(other)), 0.0, size)
                     for select in (np.minimum, np.maximum))
        if not (high - low).min() >= MIN_BOX_PX:
            raise EditError(f'the box is smaller than {MIN_BOX_PX:g} pixels; drag from corner to '
                            'corner')
        boxes = self._recording.boxes_in_view(view)
        overlap = np.clip(np.minimum(boxes[:, 2:], high) - np.maximum(boxes[:, :2], low), 0.0,
                          None).prod(axis=1)
        union = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1) + (high - low).prod() - overlap
        row = int(np.argmax(overlap / union)) if len(boxes) else -1
        is_same = row >= 0 and overlap[row] > _SAME_IOU * union[row]
        return self._put(view, np.concatenate([low, high]), row if is_same else -1)

    def take(self, view: int, pixel: Pixel) -> str:
        """Take the detector's smallest box around a pixel (2,)."""
        boxes = self._recording.boxes_in_view(view)
        row = box_at(boxes, pixel)
        if row is None:
            raise EditError('no box of the detector there; drag to draw one')
        return self._put(view, boxes[row], row)

    def _put(self, view: int, box: NDArray[np.float64], row: int) -> str:
        left, top, right, bottom = (float(value) for value in box)
        what = 'changed' if view in self.boxes else 'drew'
        self.boxes, self._offered = {**self.boxes, view: (left, top, right, bottom)}, []
        detections = self._recording.detections
        if row >= 0:
            number = detections.classes[detections.frame_offsets[view] + row]
            self.class_id = detections.class_names[number]
        _, doubt = self.fit()
        return (f'{what} the box of view {view}; boxes drawn: {len(self.boxes)}'
                + (f'; {doubt}' if doubt else ''))

    def forget(self, view: int | None) -> str:
        """Forget the box of a view, or all of them."""
        self.boxes = {key: box for key, box in self.boxes.items()
                      if view is not None and key != view}
        self._offered = []
        if not self.boxes:
            self.class_id = ''
        return f'boxes drawn: {len(self.boxes)}'

    def fit(self) -> tuple[Fit | None, str]:
        """Return the ellipsoid that fits the boxes, if there is one, and what is doubtful."""
        if self._fitted[0] is not self.boxes:
            fit, doubt = None, ''
            if len(self.boxes) > 1:
                try:
                    fit, doubt = self._fit()
                except EditError as error:
                    doubt = str(error)
            self._fitted = self.boxes, fit, doubt
        return self._fitted[1:]

    def _fit(self) -> tuple[Fit, str]:
        detections, views = self._recording.detections, sorted(self.boxes)
        return fit_boxes([detections.camera_of(view) for view in views],
                         detections.map_from_camera[views],
                         np.array([self.boxes[view] for view in views]).reshape(-1, 4))

    def create(self, label: str, class_id: str) -> str:
        """Create a landmark from the boxes, and select it."""
        document, recording = self._document, self._recording
        landmarks = document.landmarks
        fit, warning = self._fit()
        change = edits.create(landmarks, label, class_id, fit.center, fit.basis)
        (landmark_id,) = change.after
        rows = recording.boxes_of(change.apply(landmarks))[landmark_id]
        look = recording.look_of(rows, document.encoder_key)
        document.apply(edits.create(landmarks, label, class_id, fit.center, fit.basis, look))
        document.select([landmark_id])
        self.forget(None)
        hint = (f'{len(rows)} boxes of the recording show it: Refit fits it to them'
                if len(rows) >= LEAST_BOXES else '')
        return '; '.join(filter(None, [f'created {landmark_id}', warning, hint]))

    # ---- where the object lies in other views ---------------------------------------------------

    def _places(self) -> NDArray[np.float64]:
        """Return points (n, 3) in the map where the object may be."""
        fit, _ = self.fit()
        if fit is not None:
            return fit.center[None]
        if not self.boxes:
            return np.empty((0, 3))
        view, box = next(iter(self.boxes.items()))
        detections = self._recording.detections
        camera, pose = detections.camera_of(view), detections.map_from_camera[view]
        ray = np.array([(0.5 * (box[0] + box[2]) - camera.cx) / camera.fx,
                        (0.5 * (box[1] + box[3]) - camera.cy) / camera.fy, 1.0])
        points: NDArray[np.float64] = _DEPTHS_M[:, None] * (pose[:3, :3] @ ray) + pose[:3, 3]
        return points

    def guide(self, view: int) -> NDArray[np.float64]:
        """Return the line (n, 2) [px] on which the object of one box lies in another view."""
        if len(self.boxes) != 1 or view in self.boxes:
            return np.empty((0, 2))
        detections = self._recording.detections
        pixels, is_front = _project(detections.camera_of(view), detections.map_from_camera[view],
                                    self._places())
        return pixels[is_front]

    def next_view(self) -> int:
        """Return the view without a box that is best for the next one; again: another one.

        It is seen from another side, and shows as many of the object's possible places as
        possible. EditError: there is no box, or no other view shows one of these places.
        """
        places = self._places()
        if not len(places):
            raise EditError('draw the first box: it tells which views show the object')
        if len(places) > 1:
            places = places[(_DEPTHS_M > 0.8) & (_DEPTHS_M < 4.0)]
        detections, boxed = self._recording.detections, list(self.boxes)
        rays = detections.map_from_camera[:, None, :3, 3] - places
        rays /= np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), 1e-9)

        def angles_to(views: list[int]) -> NDArray[np.float64]:
            cosines = np.einsum('vpk,bpk->vbp', rays, rays[views]).max(axis=1, initial=-1.0)
            return np.asarray(np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))))

        off = np.abs(angles_to(boxed) - _GOOD_ANGLE_DEG) / _GOOD_ANGLE_DEG
        values = np.maximum(0.0, 1.0 - off) ** 2 * (angles_to(self._offered) > _OTHER_ANGLE_DEG)
        values[boxed] = 0.0
        for view in np.flatnonzero(values.any(axis=1)).tolist():
            camera = detections.camera_of(view)
            pixels, is_front = _project(camera, detections.map_from_camera[view], places)
            off_middle = np.abs(pixels / (camera.width, camera.height) - 0.5)
            values[view] *= is_front & (off_middle < 0.45).all(axis=1)
        best = int(np.argmax(values.mean(axis=1)))
        if not values[best].any():
            self._offered = []
            raise EditError('no other view is sure to show the object; choose one yourself')
        self._offered.append(best)
        return best


def _project(camera: Camera, map_from_camera: NDArray[np.float64], points: NDArray[np.float64]
             ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the pixels (n, 2) of points (n, 3), and which of them lie in front of the camera."""
    camera_from_map = invert_transform(map_from_camera)
    x, y, z = (points @ camera_from_map[:3, :3].T + camera_from_map[:3, 3]).T
    depth = np.maximum(z, 1e-6)
    u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
    return np.column_stack([u, v]), z > 0.05
