# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a recording says of landmarks: its boxes, boxes that a person drew, and relocalizations.

Relocalizations have the recording's boxes and poses. Similarities are simulated, as check_map does
it. The views are not held out: a landmark that was fitted to them fits them better than new
images.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalization import Relocalization
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.offline.mapping.association import associate
from cliploc_ros.offline.mapping.check.landmark_faults import (
    LandmarkCheck,
    Overlap,
    check_landmarks,
    find_map_overlaps,
    hear_witness,
)
from cliploc_ros.offline.mapping.check.relocalization import RecordedKeyframes, simulated
from cliploc_ros.offline.mapping.evidence import widest_angle_deg
from cliploc_ros.offline.mapping.fitting import Fit, fit_ellipsoid
from cliploc_ros.offline.mapping.labelling import embed_landmarks
from cliploc_ros.offline.mapping.landmarks import Landmarks as Ellipsoids
from cliploc_ros.offline.mapping.landmarks import group_boxes
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.refit import refit_map
from cliploc_ros.offline.mapping.views import Views, make_views
from cliploc_ros.offline.simulation import LabelModel
from cliploc_ros.offline.studio import edits
from cliploc_ros.offline.studio.edits import Change, EditError, Landmarks
from cliploc_ros.offline.studio.landmark import Encoded, looks_of, map_of

#: Fewer boxes leave an ellipsoid open.
LEAST_BOXES = 3
#: Views nearer to one another leave the distance of the object open.
LEAST_ANGLE_DEG = 25.0
MIN_BOX_PX = 4.0
_STRETCH = 2.0
#: An accepted pose farther off than this is wrong [m].
WRONG_M = 1.0


class ViewAnswer(NamedTuple):
    """The relocalizer's answer in one view; the errors are of the best pose, accepted or not."""

    view: int
    verdict: Literal['accepted', 'refused', 'wrong']
    error_m: float | None
    error_deg: float | None
    result: Relocalization

    def text(self, landmark_map: LandmarkMap) -> str:
        """Return the answer in one line."""
        result = self.result
        found = ', '.join(landmark_map.landmark_ids[match.landmark] for match in result.matches)
        parts = [f'view {self.view}: {self.verdict}']
        if result.reason:
            parts.append(result.reason)
        if self.error_m is not None and self.error_deg is not None:
            parts.append(f'pose off by {self.error_m:.2f} m, {self.error_deg:.1f} degrees')
        if result.recognized is not None and result.solved:
            parts.append(f'pose by {result.source}')
        parts.append(f'confidence {result.confidence:.2f}, {len(result.matches)} inliers'
                     + (f' ({found})' if found else ''))
        parts.append(f'{max(0, len(result.hypotheses) - 1)} rivals; similarities are simulated')
        return '; '.join(parts)


class Recording:
    """Boxes and poses of a recording of the mapped place."""

    def __init__(self, detections: PosedDetections):
        self.detections = detections

    @cached_property
    def views(self) -> Views:
        """The arrays that the kernels of mapping read."""
        return make_views(self.detections)

    def boxes_of(self, landmarks: Landmarks) -> dict[str, NDArray[np.int64]]:
        """Return the boxes that show each landmark; a box shows one at most."""
        if not landmarks:
            return {}
        numbers = {name: row for row, name in enumerate(self.detections.class_names)}
        ellipsoids = Ellipsoids(
            np.array([one.center for one in landmarks.values()]),
            np.array([one.basis for one in landmarks.values()]),
            np.array([numbers.get(one.class_id, -1) for one in landmarks.values()]))
        shown = associate(self.views, ellipsoids)
        return dict(zip(landmarks, group_boxes(shown, len(landmarks)), strict=True))

    def boxes_in_view(self, view: int) -> NDArray[np.float64]:
        """Return the detector's boxes (n, 4) in a view [px]."""
        return self.detections.detections_of(view).bboxes_xyxy

    def look_of(self, rows: NDArray[np.int64], encoder_key: str) -> Encoded | None:
        """Return the look that an encoder has of some boxes; None where it saw none of them."""
        detections = self.detections
        if detections.encoder_key != encoder_key or detections.embeddings is None or not len(rows):
            return None
        shown = np.full(len(detections.classes), -1, dtype=np.int64)
        shown[rows] = 0
        return looks_of(embed_landmarks([''], detections, shown)).get('')

    def fit_together(self, landmarks: Landmarks, landmark_ids: Sequence[str],
                     center: NDArray[np.float64], basis: NDArray[np.float64]) -> Fit | None:
        """Return one ellipsoid fitted to the boxes of several landmarks, from a start.

        None where they have too few boxes.
        """
        boxes = self.boxes_of(landmarks)
        rows = np.unique(np.concatenate([boxes[key] for key in landmark_ids]))
        return fit_ellipsoid(self.views, rows, center, basis) if len(rows) >= LEAST_BOXES else None

    def refitted(self, landmarks: Landmarks, landmark_ids: Sequence[str]
                 ) -> tuple[Change, dict[str, str]]:
        """Return the change that fits landmarks to their boxes, and why others are left out.

        EditError: one is locked. MappingError: none can be fitted.
        """
        if locked := [key for key in landmark_ids if landmarks[key].marks.is_locked]:
            raise EditError(f"landmark '{locked[0]}' is locked: unlock it first")
        chosen = np.array([key in set(landmark_ids) for key in landmarks])
        # the others keep their boxes, so that none takes those of its neighbour
        refit = refit_map(self.detections, map_of(landmarks, 'map', 'studio'), chosen)
        reasons = {key: reason for key, reason in zip(landmarks, refit.reasons, strict=True)
                   if reason is not None and key in landmark_ids}
        fitted = [key for key in landmark_ids if key not in reasons]
        return edits.take_fits(landmarks, fitted, refit.landmark_map), reasons

    def merged(self, landmarks: Landmarks, landmark_ids: Sequence[str]) -> tuple[Change, str]:
        """Return the change that merges landmarks, and how: by boxes, or else by volume."""
        change = edits.merge(landmarks, landmark_ids)
        merged = change.after[landmark_ids[0]]
        assert merged is not None
        fit = self.fit_together(landmarks, landmark_ids, merged.center, merged.basis)
        if fit is None:
            return change, 'by volume'
        return edits.merge(landmarks, landmark_ids, (fit.center, fit.basis)), 'by boxes'

    def check(self, landmarks: Landmarks) -> tuple[list[LandmarkCheck], list[Overlap]]:
        """Return the check of each landmark, the worst first, and the overlaps."""
        landmark_map = map_of(landmarks, 'map', 'studio')
        witness = hear_witness(self.views, landmark_map, self.detections.class_names)
        overlaps = find_map_overlaps(landmark_map, witness, self.views)
        return check_landmarks(landmark_map, witness, overlaps), overlaps

    def relocalize(self, landmarks: Landmarks, views: Sequence[int],
                   keyframes: RecordedKeyframes | None = None) -> list[ViewAnswer]:
        """Return the relocalizer's answers in some views; MapError without landmarks.

        An accepted pose that is off by more than a metre is wrong. Keyframes of a view's time are
        not used for it.
        """
        landmark_map = map_of(landmarks, 'map', 'studio')
        relocalizer = Relocalizer(landmark_map, RelocalizerOptions(
            k=min(RelocalizerOptions().k, len(landmark_map))))
        labels, detections = LabelModel.of(landmark_map), self.detections
        shown = np.full(len(detections.classes), -1, dtype=np.int64)
        for landmark, box_rows in enumerate(self.boxes_of(landmarks).values()):
            shown[box_rows] = landmark
        answers = []
        for view in views:
            # equal noise each time, so that only edits change the answer
            result = relocalizer.relocalize(
                [simulated(detections, view, shown, labels, 0)],
                None if keyframes is None else keyframes.recognizer(detections, view))
            if result.map_from_camera is None:
                answers.append(ViewAnswer(view, 'refused', None, None, result))
                continue
            error_m, error_deg = pose_error(result.map_from_camera,
                                            detections.map_from_camera[view])
            answers.append(ViewAnswer(view, 'refused' if not result.accepted else
                                      'wrong' if error_m > WRONG_M else 'accepted',
                                      error_m, error_deg, result))
        return answers


# ---- a landmark from boxes that a person drew ---------------------------------------------------

def fit_boxes(cameras: Sequence[Camera], map_from_camera: NDArray[np.float64],
              bboxes_xyxy: NDArray[np.float64]) -> tuple[Fit, str]:
    """Return the ellipsoid that fits boxes of one object, and what is doubtful about it, or ''.

    The boxes (n, 4) lie in undistorted images [px] of n cameras with poses (n, 4, 4).

    EditError: there are fewer than two boxes, one is too small, or their rays do not meet in front
    of the cameras.
    """
    count = len(bboxes_xyxy)
    if count < 2:
        raise EditError(f'create: boxes drawn: {count}; draw one in each of two images or more, '
                        'best three')
    for box in bboxes_xyxy:
        if not (box[2:] - box[:2] >= MIN_BOX_PX).all():
            raise EditError(f'create: the box {tuple(box.tolist())} is smaller than '
                            f'{MIN_BOX_PX:g} pixels; draw it around the whole object')
    views = make_views(PosedDetections(
        cameras=tuple(cameras), map_from_camera=map_from_camera,
        stamps_s=np.arange(count, dtype=np.float64), frame_offsets=np.arange(count + 1),
        bboxes_xyxy=bboxes_xyxy, class_names=('drawn',), classes=np.zeros(count, dtype=np.int64),
        scores=np.ones(count), camera_rows=np.arange(count)))
    # each box was drawn for itself: none shares the error of a detector that stood still
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
              key=lambda one: one.cost)
    offsets = fit.center - origins
    angle_deg = widest_angle_deg(offsets / np.linalg.norm(offsets, axis=1, keepdims=True))
    return fit, ('' if angle_deg >= LEAST_ANGLE_DEG else (
        f'the views are only {angle_deg:.0f} degrees apart, expected {LEAST_ANGLE_DEG:.0f} or '
        'more: distance and depth are uncertain; draw a box in a view from another side'))


def _meeting_point(views: Views, origins: NDArray[np.float64]
                   ) -> tuple[NDArray[np.float64], float]:
    """Return the point nearest to the rays of all boxes' centres, and the radius they suggest."""
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
    extents = views.edges[:, 2:] - views.edges[:, :2]
    return point, float(np.median(0.5 * np.sqrt(extents.prod(axis=1)) * depths))
