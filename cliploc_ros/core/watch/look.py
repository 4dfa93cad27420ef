# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One look at a given pose: the best pose near it, and the evidence that the given pose is right.

A localizer drifts by decimetres and a few degrees, and a camera may be rotated on its robot. The
projected outlines of small objects then miss their boxes. A grid of turns and shifts around the
given pose is therefore scored, and the best poses are refined. No other part of the map is
searched.

The evidence is the log odds that the given pose is right and not elsewhere. They come from a
logistic model, fitted to equal numbers of looks at right and at wrong poses in simulated worlds,
so they are log likelihood ratios. The right poses include places that changed since they were
mapped: some objects fit, others are missing or stand where nothing is mapped. At a wrong pose of
the same map, few objects fit.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.acceptance.confidence import points_utility, tags_utility, utilities
from cliploc_ros.core.acceptance.contenders import Contender, JoinedFrames, join_frames, unrefined
from cliploc_ros.core.calibration import CALIBRATION, Calibration
from cliploc_ros.core.fit.tag_pose import find_tag_places
from cliploc_ros.core.fit.verification import scores_of
from cliploc_ros.core.geometry import transforms
from cliploc_ros.core.keyframes.localization import ImageRecognizer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.visibility import Expected, expect
from cliploc_ros.core.observation import Observation, tilt_deg
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.search.frame_search import SearchedFrame, constraint_of, match_frame
from cliploc_ros.core.search.scene import VERTICAL_UNKNOWN
from cliploc_ros.core.search.strategies import Leaders, Progress

_TERMS = CALIBRATION.watch
# The grid: turns about x and y of the camera, and about z [deg]; shifts along x and z [m].
_TURNS_DEG = np.multiply((-2, -1, 0, 1, 2), _TERMS.grid_turn_deg)
_ROLLS_DEG, _SHIFTS_M = (-_TERMS.grid_roll_deg, _TERMS.grid_roll_deg), (
    -_TERMS.grid_shift_m, 0.0, _TERMS.grid_shift_m)
_STEPS = np.array([*product(_TURNS_DEG, _TURNS_DEG, (0.0,), _SHIFTS_M, _SHIFTS_M),
                   *product(_TURNS_DEG, _TURNS_DEG, _ROLLS_DEG, (0.0,), (0.0,))])
# Poses (k, 4, 4) of the grid, in the camera frame at the given pose.
_GRID = np.tile(np.eye(4), (len(_STEPS), 1, 1))
_GRID[:, :3, :3] = Rotation.from_rotvec(_STEPS[:, :3], degrees=True).as_matrix()
_GRID[:, [0, 2], 3] = _STEPS[:, 3:]
# Minimum distance between poses that are refined.
_APART = transforms.Tolerance(_TERMS.apart_m, _TERMS.apart_deg)


class Alignment(NamedTuple):
    """The best pose near a given pose."""

    joined: JoinedFrames  #: The frame, without its vertical
    fit: Contender
    away_m: float  #: Distance from the given pose
    away_deg: float

    def by_keyframes(self, recognizer: ImageRecognizer, given: NDArray[np.float64]) -> float:
        """Return the log odds that the given pose (4, 4) is right, from keyframes."""
        terms = CALIBRATION.keyframes
        seen = recognizer.recognize([given], constraint_of(self.joined.frames[0].observation,
                                                           self.joined.options))
        here, elsewhere = _here_and_elsewhere(
            [(place.map_from_camera, points_utility(place)) for place in seen.places], given)
        missed = 0.0 if here or not seen.is_complete else terms.missed * recognizer.coverage(given)
        return here - elsewhere + missed

    def by_tags(self, given: NDArray[np.float64]) -> float:
        """Return the log odds that the given pose (4, 4) is right, from tags."""
        here, elsewhere = _here_and_elsewhere([
            (place.map_from_camera, tags_utility(place)) for place in find_tag_places(
                self.joined.landmark_map.tags, self.joined.frames[0].observation)], given)
        return here - elsewhere


def _here_and_elsewhere(places: Sequence[tuple[NDArray[np.float64], float]],
                        given: NDArray[np.float64]) -> tuple[float, float]:
    """Return the greatest log odds, at least 0, of the poses at a given pose, and elsewhere."""
    here, elsewhere = (max([0.0, *(odds for pose, odds in places
                                   if transforms.SAME_ANSWER.agree(pose, given) == near)])
                       for near in (True, False))
    return here, elsewhere


def look_at(landmark_map: LandmarkMap, observation: Observation, options: RelocalizerOptions
            ) -> JoinedFrames:
    """Prepare an observation for the comparison of poses.

    Its vertical is dropped: it depends on the stated mount, which may be wrong, and must not bias
    the fit.
    """
    if observation.similarities is None:
        options = replace(options, matching='class')
    free = replace(observation, up_in_camera=None, odom_from_camera=None)
    scene, _ = match_frame(landmark_map, free, options)
    none = Leaders.none_yet(1)
    return join_frames(landmark_map, options, [SearchedFrame(
        free, scene, VERTICAL_UNKNOWN, none, none, Progress(0, 1.0))])


def align(joined: JoinedFrames, map_from_camera: NDArray[np.float64]) -> Alignment:
    """Find the best pose near a given pose (4, 4)."""
    starts = map_from_camera @ _GRID
    rotations = np.ascontiguousarray(starts[:, :3, :3].transpose(0, 2, 1))
    translations = -np.einsum('kij,kj->ki', rotations, starts[:, :3, 3])
    scores = scores_of(joined.rig, rotations, translations)
    order = np.argsort(-scores, kind='stable')
    starts = starts[order[scores[order] > 0.0]]
    finalists = [unrefined(map_from_camera),
                 *(unrefined(starts[row]) for row in _APART.distinct(starts, int(_TERMS.refined)))]
    if len(finalists) > 1:
        finalists += [joined.refined(finalist) for finalist in finalists]
    found = joined.contenders(finalists, [True] * len(finalists))
    errors = [transforms.pose_error(contender.pose, map_from_camera) for contender in found]
    near = [row for row, error in enumerate(errors)
            if error[0] < transforms.SAME_NEIGHBOURHOOD.distance_m
            and error[1] < transforms.SAME_NEIGHBOURHOOD.angle_deg]
    odds = [contender.odds
            - 0.5 * ((away_m / _TERMS.pull_m) ** 2 + (away_deg / _TERMS.pull_deg) ** 2)
            for contender, (away_m, away_deg) in zip(found, errors, strict=True)]
    fit = max(near, key=lambda row: odds[row])
    return Alignment(joined, found[fit], *errors[fit])


class LookEvidence(NamedTuple):
    """The evidence of one look for or against the given pose."""

    known: int  #: Detections of the map's classes
    matched: int  #: Objects that are where the pose predicts them
    unexplained: int  #: Other detections of the map's classes
    utility: float  #: Utility of the matched objects in the model of the acceptance [log odds]
    expected: int  #: Landmarks that the image should show
    missed: int  #: Expected landmarks that no detection shows
    away_m: float  #: Distance from the given pose to the best pose near it
    away_deg: float
    crowd: float  #: log(1 + number of pairs of a detection and a landmark in view of its class)

    def is_full(self, has_jumped: bool) -> bool:
        """Check whether the look would reveal a wrong pose; after a jump, by any objects."""
        return self.known >= _TERMS.full_objects and (
            has_jumped or self.expected >= _TERMS.full_mapped)

    @property
    def terms(self) -> dict[str, float]:
        """Return the terms of the model by their names in calibration.yaml."""
        return {
            'none': 1.0, 'utility': min(self.utility, _TERMS.most_utility),
            'any': float(self.matched > 0), 'unexplained': float(self.unexplained),
            'missed': float(self.missed), 'away': math.log1p((self.away_m / _TERMS.away_m) ** 2),
            'turned': math.log1p((self.away_deg / _TERMS.turned_deg) ** 2), 'crowd': self.crowd}

    def log_odds(self, is_full: bool, calibration: Calibration = CALIBRATION) -> float:
        """Return the log odds that the given pose is right, from the objects of a look.

        At a right pose, the place may be unmapped or the view without objects. So the evidence of
        a look that is not full against a pose is limited.
        """
        terms = calibration.watch
        if not self.known:
            return 0.0  # something may occlude all objects
        found = sum(terms[name] * value for name, value in self.terms.items())
        return min(max(found, terms.least if is_full else terms.least_unsure), terms.most)


def measure(alignment: Alignment) -> tuple[LookEvidence, Expected]:
    """Measure the evidence of an aligned look, and find the landmarks that it should show."""
    joined, fit = alignment.joined, alignment.fit
    landmark_map, observation = joined.landmark_map, joined.frames[0].observation
    index, (matches,) = landmark_map.classes, fit.matches
    classes = index.classes_of(observation.detections.class_ids)
    own = index.are_own(classes)
    taken = {match.detection for match in matches}
    unexplained = sum(row not in taken for row in np.nonzero(own)[0].tolist())
    found = expect(landmark_map, observation.camera, fit.pose,
                   np.array([match.landmark for match in matches], dtype=np.int64))
    # unexplained detections are a separate term: remove them from the utility
    utility, = utilities([fit.support]) - CALIBRATION.objects.unexplained * fit.support.unexplained
    in_view = index.of_landmarks[found.landmarks]
    pairs = sum(int((in_view == class_number).sum()) for class_number in classes[own])
    return LookEvidence(int(own.sum()), round(fit.support.inliers), unexplained, float(utility),
                        len(found.landmarks), int((~found.was_seen).sum()), alignment.away_m,
                        alignment.away_deg, math.log1p(pairs)), found


def by_vertical(map_from_camera: NDArray[np.float64], up_in_camera: NDArray[np.float64] | None,
                deviation_deg: float) -> float:
    """Return the log odds, at most 0, that a pose (4, 4) is right, from the vertical (3,)."""
    sigmas = tilt_deg(map_from_camera, up_in_camera) / math.hypot(deviation_deg, _TERMS.slope_deg)
    return -min(CALIBRATION.attitude.wrong_mount, 0.5 * sigmas ** 2)
