# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A landmark that a user creates from boxes of the object in several views.

The drawn boxes predict where the object lies in a further view: with one box, on the projection of
its ray; with two or more, at the projection of the ellipsoid that fits them.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import box_ious
from cliploc_ros.offline.mapping.evidence import widest_angle_deg
from cliploc_ros.offline.mapping.fitting import Fit, fit_ellipsoid
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.triangulation import box_radii
from cliploc_ros.offline.mapping.views import Views, make_views
from cliploc_ros.offline.studio import edits
from cliploc_ros.offline.studio.document import Document
from cliploc_ros.offline.studio.edits import EditError
from cliploc_ros.offline.studio.recording import LEAST_BOXES, Recording

#: Least angle between the views; with less, the distance of the object is uncertain.
LEAST_ANGLE_DEG = 25.0
MIN_BOX_PX = 4.0
_STRETCH = 2.0
# Possible distances of an object with a single box [m].
_DEPTHS_M = np.geomspace(0.4, 12.0, 24)
# A drawn box takes the class of a detector's box if their IoU is greater.
_SAME_IOU = 0.5
# Preferred angle between the view of the next box and the views of the other boxes [deg].
_GOOD_ANGLE_DEG = 45.0
# A repeated request means that the last view was unsuitable: closer views are skipped [deg].
_OTHER_ANGLE_DEG = 10.0


class NewLandmark:
    """The boxes by view, the class that they suggest, and the fitted ellipsoid."""

    ACTIONS = ('draw', 'forget', 'create')

    def __init__(self, document: Document, recording: Recording):
        self._document, self._recording = document, recording
        self.boxes: dict[int, list[float]] = {}
        #: Class of the detector's boxes that match the drawn boxes; '' if unknown
        self.class_id = ''
        #: The ellipsoid that fits the boxes, if there is one, and a warning about it
        self.fit: Fit | None = None
        self.doubt = ''
        # results of next_view since the last box
        self._offered: list[int] = []

    def draw(self, view: int, corner: Any, other: Any) -> str:
        """Set the box of a view, given two opposite corners (2,) [px]."""
        if type(view) is not int or not 0 <= view < len(self._recording.detections):
            raise EditError(f'there is no view {view!r:.60}')
        corners = [edits.numbers(pixel, 2, 'corner') for pixel in (corner, other)]
        camera = self._recording.detections.camera_of(view)
        low, high = np.clip(np.sort(corners, axis=0), 0.0, (camera.width, camera.height))
        if not (high - low).min() >= MIN_BOX_PX:
            raise EditError(f'the box is smaller than {MIN_BOX_PX:g} pixels; drag from corner to '
                            'corner')
        boxes = self._recording.detections.detections_of(view).bboxes_xyxy
        ious = np.append(box_ious(boxes, np.array([[*low, *high]])), 0.0)
        what, same = 'changed' if view in self.boxes else 'drew', int(np.argmax(ious))
        self._set({**self.boxes, view: [*low.tolist(), *high.tolist()]})
        if ious[same] > _SAME_IOU:
            self.class_id = self._recording.detections.detections_of(view).class_ids[same]
        return f'{what} the box of view {view + 1}; ' + '; '.join(
            filter(None, [f'boxes drawn: {len(self.boxes)}', self.doubt]))

    def forget(self, view: int | None = None) -> str:
        """Forget the box of a view, or all of them."""
        self._set({key: box for key, box in self.boxes.items()
                   if view is not None and key != view})
        if not self.boxes:
            self.class_id = ''
        return f'boxes drawn: {len(self.boxes)}'

    def _set(self, boxes: dict[int, list[float]]) -> None:
        """Replace the boxes, and fit an ellipsoid to two or more."""
        self.boxes, self._offered, self.fit, self.doubt = boxes, [], None, ''
        if len(boxes) > 1:
            try:
                self.fit, self.doubt = self._fit()
            except EditError as error:
                self.doubt = str(error)

    def _fit(self) -> tuple[Fit, str]:
        detections, views = self._recording.detections, sorted(self.boxes)
        return fit_boxes([detections.camera_of(view) for view in views],
                         detections.map_from_camera[views],
                         np.array([self.boxes[view] for view in views]).reshape(-1, 4))

    def create(self, label: str, class_id: str) -> str:
        """Create a landmark from the boxes, and select it."""
        document, recording = self._document, self._recording
        fit, warning = self._fit()
        of = str(label), str(class_id), fit.center, fit.basis
        change = edits.create(document.landmarks, *of)
        (landmark_id,) = change.after
        rows = recording.boxes_of(change.apply(document.landmarks))[landmark_id]
        document.edit(edits.create, *of, recording.look_of(rows, document.file.encoder_key))
        document.select([landmark_id])
        self.forget()
        hint = (f'{len(rows)} boxes of the recording show it: use Refit to fit it to them'
                if len(rows) >= LEAST_BOXES else '')
        return '; '.join(filter(None, [f'created {landmark_id}', warning, hint]))

    # ---- where the object lies in other views ---------------------------------------------------

    def _places(self) -> NDArray[np.float64]:
        """Return points (n, 3) in the map where the object may be."""
        if self.fit is not None:
            return self.fit.center[None]
        if not self.boxes:
            return np.empty((0, 3))
        view, box = next(iter(self.boxes.items()))
        detections = self._recording.detections
        camera, pose = detections.camera_of(view), detections.map_from_camera[view]
        middle = np.array([[box[0] + box[2], box[1] + box[3]]]) / 2.0
        ray = pose[:3, :3] @ [*camera.normalize_points(middle)[0], 1.0]
        return np.asarray(_DEPTHS_M[:, None] * ray + pose[:3, 3])

    def guide(self, view: int) -> NDArray[np.float64]:
        """Return the line (n, 2) [px] in a view on which the object of a single box lies."""
        if len(self.boxes) != 1 or view in self.boxes:
            return np.empty((0, 2))
        detections = self._recording.detections
        pixels, is_front = _project(detections.camera_of(view), detections.map_from_camera[view],
                                    self._places())
        return pixels[is_front]

    def next_view(self) -> int:
        """Return the best view for the next box; a repeated call returns a different view.

        The view has another direction, and shows as many possible positions of the object as
        possible. EditError: there is no box, or no other view shows any of these positions.
        """
        places = self._places()
        if not len(places):
            raise EditError('draw the first box, which shows where the object may be')
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
            raise EditError('no other view is certain to show the object; choose a view yourself')
        self._offered.append(best)
        return best


def _project(camera: Camera, map_from_camera: NDArray[np.float64], points: NDArray[np.float64]
             ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the pixels (n, 2) of points (n, 3), and which of them lie in front of the camera."""
    seen = (points - map_from_camera[:3, 3]) @ map_from_camera[:3, :3]
    pixels = camera.project_normalized(seen[:, :2] / np.maximum(seen[:, 2:], 1e-6))
    return pixels, seen[:, 2] > 0.05


# ---- a landmark from boxes that a person drew ---------------------------------------------------

def fit_boxes(cameras: Sequence[Camera], map_from_camera: NDArray[np.float64],
              bboxes_xyxy: NDArray[np.float64]) -> tuple[Fit, str]:
    """Fit an ellipsoid to boxes of one object; return it and a warning, '' without one.

    The boxes (n, 4) lie in undistorted images [px] of n cameras with poses (n, 4, 4).

    EditError: there are fewer than two boxes, or the rays do not meet in front of the cameras.
    """
    count = len(bboxes_xyxy)
    if count < 2:
        raise EditError(f'create: boxes drawn: {count}; draw a box in at least two images, '
                        'preferably three')
    views = make_views(PosedDetections(
        cameras=tuple(cameras), map_from_camera=map_from_camera,
        stamps_s=np.arange(count, dtype=np.float64), frame_offsets=np.arange(count + 1),
        bboxes_xyxy=bboxes_xyxy, class_names=('drawn',), classes=np.zeros(count, dtype=np.int64),
        scores=np.ones(count), camera_rows=np.arange(count)))
    # equal weights: drawn boxes have independent errors, unlike boxes of a detector at rest
    views = views._replace(weights=np.ones(count))
    origins = views.centers
    start, radius = _meeting_point(views, origins)
    # a sphere, one stretched along each axis of the map, and one along a diagonal
    sphere = radius * np.eye(3)
    bases = [sphere, *(sphere * np.where(np.arange(3) == axis, _STRETCH, 1.0 / np.sqrt(_STRETCH))
                       for axis in range(3)),
             Rotation.from_euler('z', 45, degrees=True).as_matrix()
             @ (sphere * (_STRETCH, 1.0 / _STRETCH, 1.0))]
    fit = min((fit_ellipsoid(views, np.arange(count), start, basis) for basis in bases),
              key=lambda candidate: candidate.cost)
    offsets = fit.center - origins
    angle_deg = widest_angle_deg(offsets / np.linalg.norm(offsets, axis=1, keepdims=True))
    return fit, ('' if angle_deg >= LEAST_ANGLE_DEG else (
        f'the views are only {angle_deg:.0f} degrees apart, expected {LEAST_ANGLE_DEG:.0f} or '
        'more: distance and depth are uncertain; draw a box in a view from another side'))


def _meeting_point(views: Views, origins: NDArray[np.float64]
                   ) -> tuple[NDArray[np.float64], float]:
    """Return the point closest to the rays of all box centres, and a radius by the box sizes."""
    middles = 0.5 * (views.edges[:, :2] + views.edges[:, 2:])
    rays = np.column_stack([middles, np.ones(len(middles))])
    rays = np.einsum('fji,fj->fi', views.rotations, rays)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    try:
        point = np.linalg.solve(across.sum(axis=0), np.einsum('fij,fj->i', across, origins))
    except np.linalg.LinAlgError:
        raise EditError('create: the views look along one line; draw a box in a view from '
                        'another side') from None
    depths = np.einsum('fij,j->fi', views.rotations, point)[:, 2] + views.translations[:, 2]
    if not depths.min() > 0.05:
        raise EditError('create: the boxes do not show one object: their rays meet behind a '
                        'camera; draw the same object in all views')
    return point, float(np.median(box_radii(views, np.arange(len(depths))) * depths))
