# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the studio knows of a recording: boxes and poses, and what they say of landmarks."""

from collections.abc import Iterable, Mapping
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.mapping.association import associate
from cliploc_ros.mapping.checking.landmark_faults import (
    LandmarkCheck,
    check_landmarks,
    find_map_overlaps,
    hear_witness,
)
from cliploc_ros.mapping.fitting import Fit, fit_ellipsoid
from cliploc_ros.mapping.landmarks import Landmarks as Ellipsoids
from cliploc_ros.mapping.landmarks import group_boxes
from cliploc_ros.mapping.options import MappingOptions
from cliploc_ros.mapping.posed_detections import PosedDetections
from cliploc_ros.mapping.refit import RefitMap, refit_map
from cliploc_ros.mapping.views import Views, make_views
from cliploc_ros.studio.changes import EditError
from cliploc_ros.studio.landmark import Landmark, map_of
from cliploc_ros.studio.looks import Look, look_of_boxes
from cliploc_ros.studio.picture import project

#: Fewer boxes leave an ellipsoid open.
LEAST_BOXES = 3


class Recording:
    """Boxes and poses of a recording of the mapped place.

    Parameters
    ----------
    detections : PosedDetections
    """

    def __init__(self, detections: PosedDetections):
        self.detections = detections
        self.options = MappingOptions()

    @cached_property
    def views(self) -> Views:
        """Return what the kernels of mapping read."""
        return make_views(self.detections, self.options)

    def boxes_of(self, landmarks: Mapping[str, Landmark]) -> dict[str, NDArray[np.int64]]:
        """Return the boxes that show each landmark; a box shows one at most."""
        if not landmarks:
            return {}
        numbers = {name: row for row, name in enumerate(self.detections.class_names)}
        ellipsoids = Ellipsoids(
            np.array([one.center for one in landmarks.values()]),
            np.array([one.basis for one in landmarks.values()]),
            np.array([numbers.get(one.class_id, -1) for one in landmarks.values()]))
        shown = associate(self.views, ellipsoids, self.options.association_iou)
        return dict(zip(landmarks, group_boxes(shown, len(landmarks)), strict=True))

    def look_of(self, rows: NDArray[np.int64], encoder_key: str) -> Look | None:
        """Return what an encoder saw in some boxes; None where this recording does not know it."""
        if self.detections.encoder_key != encoder_key:
            return None
        return look_of_boxes(self.detections, rows)

    def best_views(self, landmark: Landmark) -> list[tuple[int, NDArray[np.float64]]]:
        """Return the views that show all of a landmark, and the box (4,) there; largest first."""
        camera = self.detections.camera
        size = np.array([camera.width, camera.height], dtype=np.float64)
        found = []
        for view, pose in enumerate(self.detections.map_from_camera):
            for one in project({'': landmark}, camera, pose):
                half = np.sqrt(one.ellipse[[2, 4]])
                box = np.concatenate([one.ellipse[:2] - half, one.ellipse[:2] + half])
                if box.min() >= 0.0 and (box[2:] <= size).all():
                    found.append((view, box))
        return sorted(found, key=lambda pair: -float((pair[1][2:] - pair[1][:2]).prod()))

    def refit(self, landmarks: Mapping[str, Landmark], landmark_ids: Iterable[str]) -> RefitMap:
        """Fit some of the landmarks to their boxes.

        The others keep their boxes, so that none takes those of its neighbour.

        Raises
        ------
        MappingError
            None can be fitted.
        """
        chosen = set(landmark_ids)
        return refit_map(self.detections, map_of(landmarks, 'map', 'studio'),
                         np.array([key in chosen for key in landmarks]), self.options)

    def fit_together(self, landmarks: Mapping[str, Landmark], landmark_ids: Iterable[str],
                     center: NDArray[np.float64], basis: NDArray[np.float64]) -> Fit:
        """Return one ellipsoid fitted to the boxes of several landmarks, from a start.

        Raises
        ------
        EditError
            They have too few boxes.
        """
        boxes = self.boxes_of(landmarks)
        rows = np.unique(np.concatenate([boxes[key] for key in landmark_ids]))
        if len(rows) < LEAST_BOXES:
            raise EditError(f'merge: {len(rows)} boxes show these landmarks, {LEAST_BOXES} are '
                            'needed for a fit')
        return fit_ellipsoid(self.views, rows, center, basis)

    def check(self, landmarks: Mapping[str, Landmark]) -> list[LandmarkCheck]:
        """Return the check of each landmark, the worst first."""
        landmark_map = map_of(landmarks, 'map', 'studio')
        witness = hear_witness(self.views, landmark_map, self.detections.class_names,
                               self.options)
        overlaps = find_map_overlaps(landmark_map, witness, self.views)
        return check_landmarks(landmark_map, witness, overlaps, self.options)
