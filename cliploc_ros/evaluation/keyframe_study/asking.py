# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One query by objects, by the baseline, by keyframes, and by both."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.recognition import ObjectsThere, chance_recognized, objects_there
from cliploc_ros.core.combination import combine
from cliploc_ros.core.fit.covariance import normalized_square
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer, Recognition
from cliploc_ros.core.maps.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Detections, Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalization import Relocalization
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.datasets.frames import Frame
from cliploc_ros.evaluation.keyframe_study.baseline import Baseline
from cliploc_ros.models.protocols import ObjectDetector
from cliploc_ros.recording.networks import MAX_DETECTIONS

#: Classes alone: no CLIP weights are at hand for the kitchen.
OPTIONS = RelocalizerOptions(matching='class', time_budget_s=0.25)
_NOTHING = Relocalization(False, 'not searched')
#: Poses of objects that propose keyframes.
MOST_GUESSES = 3


class Query(NamedTuple):
    """An image, what a detector says about it, and the true pose; None: it is of another room."""

    image_rgb: NDArray[np.uint8]
    camera: Camera
    detections: Detections
    truth: NDArray[np.float64] | None


def query_of(frame: Frame, detector: ObjectDetector, is_here: bool = True) -> Query:
    """Return an image with its detections; not here: of another room."""
    camera = frame.camera
    boxes = detector.detect(frame.image_rgb).usable(camera.width, camera.height, MAX_DETECTIONS)
    return Query(frame.image_rgb, camera, boxes, frame.map_from_camera if is_here else None)


@dataclass(frozen=True)
class Outcome:
    """What one way of localizing says: error [m], accepted, CPU time [ms], NEES, probability."""

    error_m: float
    accepted: bool
    cpu_ms: float
    nees: float
    confidence: float = 0.0


@dataclass(frozen=True)
class Row:
    """The results of one query; the evidence is what the acceptance is fitted on."""

    case: str
    number: int
    ways: dict[str, Outcome]
    evidence: dict[str, float]

    def as_dict(self) -> dict[str, Any]:
        """Return the row for JSON."""
        return asdict(self)


class Place:
    """A map with its layer and, where wanted, the baseline."""

    def __init__(self, landmark_map: LandmarkMap, keyframes: KeyframeLocalizer,
                 baseline: Baseline | None = None) -> None:
        self.landmark_map = landmark_map
        self.keyframes = keyframes
        self._baseline = baseline
        self._relocalizer = Relocalizer(landmark_map, OPTIONS)
        self._relocalizer.warm_up()

    def ask(self, case: str, number: int, query: Query) -> Row:
        """Localize a query in every way."""
        observation = Observation(query.camera, query.detections)
        begin = time.process_time()
        found = self._relocalizer.relocalize([observation])
        searched = time.process_time()
        seen = self.keyframes.localize(query.image_rgb, query.camera,
                                       [one.map_from_camera for one in found.hypotheses
                                        ][:MOST_GUESSES])
        there = objects_there(self.landmark_map, observation, seen.places[0].map_from_camera
                              ) if seen.places else ObjectsThere(0, 0)
        both = combine(found, seen, there, OPTIONS)
        matched = time.process_time()
        alone = combine(_NOTHING, seen, ObjectsThere(0, 0), OPTIONS)
        ways = {'landmarks': _outcome(found, query.truth, searched - begin),
                'keyframes': _outcome(alone, query.truth, matched - searched),
                'both': _outcome(both, query.truth, matched - begin)}
        if self._baseline is not None:
            begin = time.process_time()
            pose = self._baseline.localize(query.image_rgb, query.camera)
            spent = time.process_time() - begin
            ways['baseline'] = Outcome(_error(pose, query.truth), pose is not None, 1e3 * spent,
                                       np.inf)
        return Row(case, number, ways, _evidence(seen, there, found, query.truth))


def _outcome(found: Relocalization, truth: NDArray[np.float64] | None, spent_s: float) -> Outcome:
    pose, nees = found.map_from_camera, np.inf
    if pose is not None and truth is not None and found.covariance is not None:
        nees = normalized_square(pose, found.covariance, truth)
    return Outcome(_error(pose, truth), found.accepted, 1e3 * spent_s, float(nees),
                   found.confidence)


def _error(pose: NDArray[np.float64] | None, truth: NDArray[np.float64] | None) -> float:
    return np.inf if pose is None or truth is None else pose_error(pose, truth)[0]


def _evidence(seen: Recognition, there: ObjectsThere, found: Relocalization,
              truth: NDArray[np.float64] | None) -> dict[str, float]:
    if not seen.places:
        return {}
    first = seen.places[0]
    return {'error_m': _error(first.map_from_camera, truth), 'inliers': first.inliers,
            'rival': seen.rival, 'confirmed': first.confirmed, 'expected': first.expected,
            'explained': there.explained, 'unexplained': there.unexplained,
            'chance': chance_recognized(seen, there),
            'objects_confidence': found.confidence}


def table(rows: Sequence[Row]) -> list[str]:
    """Return the figures of each case and way, one line each."""
    lines = [f'{"case":45} {"way":10} {"n":>3}   .1  .25   .5    1  median  accepted  '
             'precision  recall  in 95 %  CPU ms']
    for case in dict.fromkeys(row.case for row in rows):
        of_case = [row for row in rows if row.case == case]
        for way in of_case[0].ways:
            lines.append(f'{case:45} {way:10} ' + _figures([row.ways[way] for row in of_case]))
    return lines


def _figures(outcomes: Sequence[Outcome]) -> str:
    errors = np.array([one.error_m for one in outcomes])
    accepted = np.array([one.accepted for one in outcomes])
    right = errors < 1.0
    nees = np.array([one.nees for one in outcomes])[accepted & np.isfinite(
        [one.nees for one in outcomes])]
    shares = ' '.join(f'{np.mean(errors < limit):4.2f}' for limit in (0.1, 0.25, 0.5, 1.0))
    precision = np.mean(right[accepted]) if accepted.any() else np.nan
    recall = np.mean(accepted[right]) if right.any() else np.nan
    inside = np.mean(nees < 12.59) if len(nees) else np.nan  # chi-squared, 6 degrees of freedom
    return (f'{len(errors):3} {shares}  {np.median(errors):6.3f}  {accepted.sum():8}  '
            f'{precision:9.2f}  {recall:6.2f}  {inside:7.2f}  '
            f'{np.mean([one.cpu_ms for one in outcomes]):6.0f}')
