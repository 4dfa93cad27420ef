# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a recording says of landmarks: its boxes, and relocalizations.

Relocalizations have the recording's boxes and poses. Similarities are simulated, as check_map does
it. The views are not held out: a landmark that was fitted to them fits them better than new
images.
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.mapping.association import associate
from cliploc_ros.offline.mapping.check.landmark_faults import Witness, hear_witness
from cliploc_ros.offline.mapping.check.relocalization import (
    RecordedKeyframes,
    Trial,
    make_relocalizer,
    simulated,
    try_view,
)
from cliploc_ros.offline.mapping.fitting import fit_ellipsoid
from cliploc_ros.offline.mapping.labelling import embed_landmarks
from cliploc_ros.offline.mapping.landmarks import group_boxes, landmarks_of_map
from cliploc_ros.offline.mapping.options import CheckOptions, MappingOptions
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.refit import refit_map
from cliploc_ros.offline.mapping.views import Views, make_views
from cliploc_ros.offline.simulation.labels import LabelModel
from cliploc_ros.offline.studio import edits
from cliploc_ros.offline.studio.edits import Change, EditError
from cliploc_ros.offline.studio.landmark import Encoded, Landmarks, looks_of, map_of

#: Fewer boxes leave an ellipsoid open.
LEAST_BOXES = 3


class Recording:
    """Boxes and poses of a recording of the mapped place."""

    def __init__(self, detections: PosedDetections):
        self.detections = detections
        self.options = MappingOptions()

    @cached_property
    def views(self) -> Views:
        """The arrays that the kernels of mapping read."""
        return make_views(self.detections, self.options)

    def witness(self, landmark_map: LandmarkMap) -> Witness:
        """Return what the boxes say of a map."""
        return hear_witness(self.views, landmark_map, self.detections.class_names, self.options)

    def boxes_of(self, landmarks: Landmarks) -> dict[str, NDArray[np.int64]]:
        """Return the boxes that show each landmark; a box shows one at most."""
        if not landmarks:
            return {}
        shown = associate(self.views, landmarks_of_map(
            map_of(landmarks), self.detections.class_names), self.options.association_iou)
        return dict(zip(landmarks, group_boxes(shown, len(landmarks)), strict=True))

    def look_of(self, rows: NDArray[np.int64], encoder_key: str) -> Encoded | None:
        """Return the look that an encoder has of some boxes; None where it saw none of them."""
        detections = self.detections
        if detections.encoder_key != encoder_key or detections.embeddings is None or not len(rows):
            return None
        shown = np.full(len(detections.classes), -1, dtype=np.int64)
        shown[rows] = 0
        return looks_of(embed_landmarks([''], detections, shown)).get('')

    def refitted(self, landmarks: Landmarks, landmark_ids: Sequence[str]
                 ) -> tuple[Change, dict[str, str]]:
        """Return the change that fits landmarks to their boxes, and why others are left out.

        EditError: one is locked. MappingError: none can be fitted.
        """
        if locked := [key for key in landmark_ids if landmarks[key].marks.is_locked]:
            raise EditError(f"landmark '{locked[0]}' is locked: unlock it first")
        chosen = np.array([key in set(landmark_ids) for key in landmarks])
        # the others keep their boxes, so that none takes those of its neighbour
        refit = refit_map(self.detections, map_of(landmarks), chosen, self.options)
        reasons = {key: reason for key, reason in zip(landmarks, refit.reasons, strict=True)
                   if reason is not None and key in landmark_ids}
        fitted = [key for key in landmark_ids if key not in reasons]
        return edits.take_fits(landmarks, fitted, refit.landmark_map), reasons

    def merged(self, landmarks: Landmarks, landmark_ids: Sequence[str]) -> tuple[Change, str]:
        """Return the change that merges landmarks, and how: by boxes, or else by volume."""
        change = edits.merge(landmarks, landmark_ids)
        merged = change.after[landmark_ids[0]]
        assert merged is not None
        boxes = self.boxes_of(landmarks)
        rows = np.unique(np.concatenate([boxes[key] for key in landmark_ids]))
        fit = (fit_ellipsoid(self.views, rows, merged.center, merged.basis)
               if len(rows) >= LEAST_BOXES else None)
        if fit is None:
            return change, 'by volume'
        return edits.merge(landmarks, landmark_ids, (fit.center, fit.basis)), 'by boxes'

    def relocalize(self, landmarks: Landmarks, views: Sequence[int],
                   keyframes: RecordedKeyframes | None = None) -> dict[int, Trial]:
        """Return the relocalizer's answers in some views; MapError without landmarks.

        Keyframes of a view's time are not used for it.
        """
        landmark_map, options, detections = map_of(landmarks), CheckOptions(), self.detections
        relocalizer, labels = make_relocalizer(landmark_map, options), LabelModel.of(landmark_map)
        shown = np.full(len(detections.classes), -1, dtype=np.int64)
        for landmark, rows in enumerate(self.boxes_of(landmarks).values()):
            shown[rows] = landmark
        # equal noise each time, so that only edits change the answer
        return {view: try_view(
            relocalizer, simulated(detections, view, shown, labels, options.random_seed),
            detections.map_from_camera[view], 0, options, float(detections.stamps_s[view]),
            None if keyframes is None else keyframes.recognizer(detections, view))
            for view in views}
