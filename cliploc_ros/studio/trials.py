# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the relocalizer would answer in recorded views, with the map as it is now.

Boxes and poses are the recording's. Similarities are simulated, as check_map does it. The views
are not held out: a landmark that was fitted to them fits them better than new images.
"""

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalization import Relocalization
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.mapping.checking.label_model import LabelModel
from cliploc_ros.studio.landmark import Landmark, map_of
from cliploc_ros.studio.recording import Recording

Verdict = Literal['accepted', 'refused', 'wrong']
#: An accepted pose farther off than this is wrong [m].
WRONG_M = 1.0


class Answer(NamedTuple):
    """The relocalizer's answer in one view.

    Parameters
    ----------
    view : int
    verdict : str
        'accepted', 'refused', or 'wrong': a pose that is off by more than a metre was accepted.
    error_m, error_deg : float or None
        Of the best pose, accepted or not.
    result : Relocalization
    """

    view: int
    verdict: Verdict
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
        parts.append(f'confidence {result.confidence:.2f}, {len(result.matches)} inliers'
                     + (f' ({found})' if found else ''))
        parts.append(f'{max(0, len(result.hypotheses) - 1)} rivals; similarities are simulated')
        return '; '.join(parts)


def relocalize(landmarks: Mapping[str, Landmark], recording: Recording, views: Sequence[int]
               ) -> list[Answer]:
    """Return the answers in some views.

    Raises
    ------
    MapError
        There are no landmarks.
    """
    landmark_map = map_of(landmarks, 'map', 'studio')
    options = RelocalizerOptions(k=min(RelocalizerOptions().k, len(landmark_map)))
    relocalizer, labels = Relocalizer(landmark_map, options), LabelModel.of(landmark_map)
    shown = np.full(len(recording.detections.classes), -1, dtype=np.int64)
    for row, boxes in enumerate(recording.boxes_of(landmarks).values()):
        shown[boxes] = row
    return [_answer(relocalizer, labels, recording, shown, view) for view in views]


def _answer(relocalizer: Relocalizer, labels: LabelModel, recording: Recording,
            shown: NDArray[np.int64], view: int) -> Answer:
    detections = recording.detections
    rows = slice(*detections.frame_offsets[view:view + 2])
    class_ids = tuple(detections.class_names[one] for one in detections.classes[rows])
    boxes = detections.bboxes_xyxy[rows]
    # equal noise each time, so that only edits change the answer
    rng = np.random.default_rng([0, view])
    similarities = labels.similarities(shown[rows], class_ids, boxes, rng)
    result = relocalizer.relocalize([Observation(
        detections.camera, Detections(boxes, class_ids, detections.scores[rows]), similarities)])
    estimate = result.map_from_camera
    if estimate is None:
        return Answer(view, 'refused', None, None, result)
    error_m, error_deg = pose_error(estimate, detections.map_from_camera[view])
    verdict: Verdict = 'refused'
    if result.accepted:
        verdict = 'wrong' if error_m > WRONG_M else 'accepted'
    return Answer(view, verdict, error_m, error_deg, result)
