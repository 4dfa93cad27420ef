# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The recording of a studio: boxes and outlines of landmarks in its views, and relocalization.

Relocalization uses the boxes and poses of the recording. Similarities are simulated, as in
check_map. The views are not held out: landmarks that were fitted to them match them better than
new images.
"""

from collections.abc import Sequence
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.ellipsoid import ellipse_bboxes, shape_matrices
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.localizer import Localizer
from cliploc_ros.core.map.landmark_embeddings import LandmarkEmbeddings
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.datasets.images import Images
from cliploc_ros.offline.mapping.association import associate
from cliploc_ros.offline.mapping.building import refit_map
from cliploc_ros.offline.mapping.check import relocalization
from cliploc_ros.offline.mapping.check.findings import Witness, hear_witness
from cliploc_ros.offline.mapping.fitting import fit_ellipsoid
from cliploc_ros.offline.mapping.labelling import embed_landmarks
from cliploc_ros.offline.mapping.landmarks import group_boxes, landmarks_of_map
from cliploc_ros.offline.mapping.options import CheckOptions
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.sightings import (
    Sighting,
    crop_around,
    find_sightings,
    outlines_in_view,
)
from cliploc_ros.offline.mapping.views import Views, make_views
from cliploc_ros.offline.simulation import LabelModel
from cliploc_ros.offline.studio import edits
from cliploc_ros.offline.studio.edits import Change, EditError, Landmarks, map_of

#: Least number of boxes that determine an ellipsoid.
LEAST_BOXES = 3
# Margin of a crop around a box, as a share of its size.
_MARGIN = 0.25


class Recording:
    """Boxes and poses of a recording of the mapped place, and optionally its images."""

    def __init__(self, detections: PosedDetections, images: Images | None = None,
                 is_size_given: bool = False):
        self.detections, self.images = detections, images
        self.is_size_given = is_size_given  # by the user, see CheckOptions

    @cached_property
    def views(self) -> Views:
        """The arrays for the kernels of mapping."""
        return make_views(self.detections)

    def witness(self, landmark_map: LandmarkMap) -> Witness:
        """Return the evidence of the boxes about a map."""
        return hear_witness(self.views, landmark_map, self.detections.class_names)

    def boxes_of(self, landmarks: Landmarks) -> dict[str, NDArray[np.int64]]:
        """Return the boxes of each landmark; a box shows at most one landmark."""
        return dict(zip(landmarks, group_boxes(self._shown(landmarks), len(landmarks)),
                        strict=True)) if landmarks else {}

    def _shown(self, landmarks: Landmarks) -> NDArray[np.int64]:
        """Return the number of the landmark that each box (n,) shows, -1 for none."""
        return associate(self.views, landmarks_of_map(
            map_of(landmarks), self.detections.class_names))

    def outlines(self, landmarks: Landmarks, view: int) -> dict[str, NDArray[np.float64]]:
        """Return the outlines cx, cy, exx, exy, eyy [px] of landmarks in a view, nearest first."""
        if not landmarks:
            return {}
        camera, centers = self.detections.camera_of(view), _array(landmarks, 'center')
        ellipses = outlines_in_view(self.detections, view, centers, shape_matrices(
            _array(landmarks, 'semi_axes'), _array(landmarks, 'quat_xyzw')))
        boxes = ellipse_bboxes(ellipses)
        distances = np.linalg.norm(centers - self.detections.map_from_camera[view, :3, 3], axis=1)
        with np.errstate(invalid='ignore'):
            is_inside = (boxes[:, 2:] > 0.0).all(axis=1) & (
                boxes[:, :2] < (camera.width, camera.height)).all(axis=1)
        ids = list(landmarks)
        return {ids[row]: ellipses[row] for row in np.argsort(distances, kind='stable')
                if is_inside[row]}

    def sightings(self, landmarks: Landmarks, landmark_id: str, limit: int = 6) -> list[Sighting]:
        """Return the views that show a landmark best; CliplocError: an image cannot be read."""
        landmark = landmarks[landmark_id]
        return find_sightings(
            self.detections, self.boxes_of(landmarks)[landmark_id], landmark.center,
            shape_matrices(landmark.semi_axes[None], landmark.quat_xyzw[None])[0], limit,
            None if self.images is None else self._sharpness)

    def _sharpness(self, sighting: Sighting) -> float:
        """Return the share of fine detail in the image around the landmark."""
        crop = self.crop(sighting.view, sighting.bbox_xyxy)
        if crop is None:
            return 0.0
        grey = cv2.cvtColor(crop, cv2.COLOR_RGB2GRAY)
        return float(cv2.Laplacian(grey, cv2.CV_64F).var() / max(1.0, float(grey.var())))

    def image(self, view: int) -> NDArray[np.uint8] | None:
        """Return the undistorted RGB image (h, w, 3) of a view; None without an image."""
        if self.images is None or not 0 <= view < len(self.detections):
            return None
        return self.images.of(self.detections, view)

    def crop(self, view: int, box: NDArray[np.float64]) -> NDArray[np.uint8] | None:
        """Return the crop of a box (4,) [px] with a margin.

        None without an image, or if the box is not finite.
        """
        image = self.image(view)
        if image is None or not np.isfinite(box).all():
            return None
        return crop_around(image, box, _MARGIN)

    def look_of(self, rows: NDArray[np.int64], encoder_key: str) -> LandmarkEmbeddings | None:
        """Return the look by an encoder of the boxes `rows`; None without their embeddings."""
        detections = self.detections
        if detections.encoder_key != encoder_key or detections.embeddings is None:
            return None
        shown = np.full(len(detections.classes), -1, dtype=np.int64)
        shown[rows] = 0
        found = embed_landmarks([''], detections, shown)
        return found if found.is_known.all() else None

    def refitted(self, landmarks: Landmarks, landmark_ids: Sequence[str]
                 ) -> tuple[Change, dict[str, str]]:
        """Return the change that fits landmarks to their boxes, and why others are not fitted.

        EditError: a landmark is locked. MappingError: no landmark can be fitted.
        """
        if locked := [key for key in landmark_ids if landmarks[key].is_locked]:
            raise EditError(f"landmark '{locked[0]}' is locked: unlock it first")
        chosen = np.array([key in set(landmark_ids) for key in landmarks])
        # all landmarks take part, so that none gets the boxes of its neighbour
        refit = refit_map(self.detections, map_of(landmarks), chosen)
        reasons = {key: reason for key, reason in zip(landmarks, refit.reasons, strict=True)
                   if reason is not None and key in landmark_ids}
        fitted = [key for key in landmark_ids if key not in reasons]
        return edits.take_fits(landmarks, fitted, refit.landmark_map), reasons

    def merged(self, landmarks: Landmarks, landmark_ids: Sequence[str]) -> tuple[Change, str]:
        """Return the change that merges landmarks, and the method: 'by boxes' or 'by volume'."""
        change = edits.merge(landmarks, landmark_ids)
        merged = change.after[landmark_ids[0]]
        assert merged is not None
        boxes = self.boxes_of(landmarks)
        rows = np.unique(np.concatenate([boxes[key] for key in landmark_ids]))
        if len(rows) < LEAST_BOXES:
            return change, 'by volume'
        fit = fit_ellipsoid(self.views, rows, merged.center, merged.basis)
        return edits.merge(landmarks, landmark_ids, (fit.center, fit.basis)), 'by boxes'

    def relocalize(self, landmarks: Landmarks, views: Sequence[int],
                   layer: KeyframeLayer | None = None) -> dict[int, relocalization.Trial]:
        """Return the relocalizer's answers in some views; MapError: there are no landmarks.

        Each view is an independent question to a new localizer, so that only edits change the
        answers. The keyframes of a view itself are not used for it.
        """
        keyframes = None
        if layer is not None and self.images is not None:
            keyframes = relocalization.RecordedKeyframes(layer, self.image)
        landmark_map, options, detections = map_of(landmarks), CheckOptions(), self.detections
        relocalizer = relocalization.make_relocalizer(landmark_map, options)
        labels = LabelModel.of(landmark_map)
        shown, answers = self._shown(landmarks), {}
        for view in views:
            query = relocalization.simulated(detections, view, shown, labels, options.random_seed)
            localizer = Localizer(relocalizer)
            if keyframes is not None:
                query = keyframes.with_image(query)
                localizer = Localizer(relocalizer, keyframes.elsewhere(query.map_from_camera))
            answers[view] = relocalization.try_view(localizer, query, 0, options)
        return answers


def _array(landmarks: Landmarks, name: str) -> NDArray[np.float64]:
    return np.array([getattr(landmark, name) for landmark in landmarks.values()])
