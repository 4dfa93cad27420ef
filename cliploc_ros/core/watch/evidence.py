# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The evidence of one look: log odds that the given pose is right, against one elsewhere.

A logistic model of looks of right and of wrong poses in simulated worlds, as many of each, so its
log odds are those of a likelihood ratio. Right poses include those of places that changed since
they were mapped: some objects fit, others are missing or stand where nothing is mapped. At a
wrong pose of the same map little fits.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.calibration import CALIBRATION, Calibration
from cliploc_ros.core.acceptance.confidence import points_utility, utilities
from cliploc_ros.core.geometry.transforms import SAME_ANSWER
from cliploc_ros.core.keyframes.localization import ImageRecognizer
from cliploc_ros.core.search.frame_search import constraint_of
from cliploc_ros.core.watch.alignment import Alignment
from cliploc_ros.core.watch.expectation import Expected, expect

# A wrong pose shows where this many objects are in the image, and so many landmarks should be.
_OBJECTS, _MAPPED = 3, 2


class LookEvidence(NamedTuple):
    """What one look says of the given pose."""

    known: int  #: Detections of the map's classes
    matched: int  #: Objects that are where the pose expects them
    unexplained: int  #: Other detections of the map's classes
    utility: float  #: Of the matched objects, by the acceptance's model [log odds]
    expected: int  #: Landmarks that the image should show
    missed: int  #: Those of them that no detection shows
    away_m: float  #: From the given pose to the best one near it
    away_deg: float
    crowd: float  #: Logarithm of the pairs of a detection and a landmark in view of its class

    def is_full(self, has_jumped: bool) -> bool:
        """Return whether a wrong pose would show; one that jumped need not be at a mapped spot."""
        return self.known >= _OBJECTS and (has_jumped or self.expected >= _MAPPED)

    @property
    def terms(self) -> dict[str, float]:
        """Return the terms of the model by their names in calibration.yaml."""
        return {
            'none': 1.0, 'utility': min(self.utility, 12.0), 'any': float(self.matched > 0),
            'unexplained': float(self.unexplained), 'missed': float(self.missed),
            'away': math.log1p((self.away_m / 0.3) ** 2),
            'turned': math.log1p((self.away_deg / 8.0) ** 2), 'crowd': self.crowd}


def measure(alignment: Alignment) -> tuple[LookEvidence, Expected]:
    """Return what an aligned look says, and the landmarks that it expects."""
    joined, fit = alignment.joined, alignment.fit
    landmark_map, observation = joined.landmark_map, joined.frames[0].observation
    index, (matches,) = landmark_map.classes, fit.matches
    classes = index.classes_of(observation.detections.class_ids)
    own = index.are_own(classes)
    taken = {one.detection for one in matches}
    unexplained = sum(row not in taken for row in np.nonzero(own)[0].tolist())
    found = expect(landmark_map, observation.camera, fit.pose,
                   np.array([one.landmark for one in matches], dtype=np.int64))
    # what nothing explains is a term of its own
    utility, = utilities([fit.support]) - CALIBRATION.objects.unexplained * fit.support.unexplained
    in_view = index.of_landmarks[found.landmarks]
    pairs = sum(int((in_view == one).sum()) for one in classes[own])
    return LookEvidence(int(own.sum()), round(fit.support.inliers), unexplained, float(utility),
                        len(found.landmarks), int((~found.was_seen).sum()), alignment.away_m,
                        alignment.away_deg, math.log1p(pairs)), found


def log_odds(evidence: LookEvidence, is_full: bool, calibration: Calibration = CALIBRATION
             ) -> float:
    """Return the log odds of a look by its objects that the given pose is right.

    A place that the map does not show is no wrong pose, nor is a view without objects: a look that
    is not full says little against a pose.
    """
    terms = calibration.watch
    if not evidence.known:
        return 0.0  # something may hide everything
    found = sum(terms[name] * value for name, value in evidence.terms.items())
    return min(max(found, terms.least if is_full else terms.least_unsure), terms.most)


def by_keyframes(recognizer: ImageRecognizer, alignment: Alignment,
                 given: NDArray[np.float64]) -> float:
    """Return the log odds by keyframes that a given pose (4, 4) is right."""
    joined, terms = alignment.joined, CALIBRATION.keyframes
    constraint = constraint_of(joined.frames[0].observation, joined.options)
    seen = recognizer.recognize([given], constraint)
    here, elsewhere = (max([0.0] + [
        points_utility(one) for one in seen.places
        if SAME_ANSWER.agree(one.map_from_camera, given) == near]) for near in (True, False))
    missed = 0.0 if here or not seen.is_complete else terms.missed * recognizer.coverage(given)
    return here - elsewhere + missed


def by_vertical(map_from_camera: NDArray[np.float64], up_in_camera: NDArray[np.float64] | None,
                deviation_deg: float) -> float:
    """Return the log odds, 0 or less, of a given pose (4, 4) by the vertical (3,)."""
    if up_in_camera is None:
        return 0.0
    cosine = float(map_from_camera[2, :3] @ up_in_camera)
    tilt_deg = math.degrees(math.acos(min(1.0, max(-1.0, cosine))))
    # a localizer in the plane ignores slopes of a few degrees
    sigmas = tilt_deg / math.hypot(deviation_deg, 3.0)
    return -min(CALIBRATION.attitude.wrong_mount, 0.5 * sigmas ** 2)
