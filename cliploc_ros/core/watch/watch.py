# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Entry point of the watch: Watch.look(observation, map_from_camera) -> WatchReport.

The probability that a localizer is right is estimated by a Bayes filter over looks. Between looks
a localizer may get lost or recover, so the probability decays to one half with time and distance.
A pose that jumps relative to odometry starts a new hypothesis. Looks from the same spot share
errors, such as the errors of the map, so further looks of a standing robot add little information.
"""

import math
from collections import deque
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.verdict import too_tilted
from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.geometry.transforms import SAME_PLACE, invert_transform, is_rigid, pose_error
from cliploc_ros.core.keyframes.localization import ImageRecognizer
from cliploc_ros.core.map.presence import Missing
from cliploc_ros.core.observation import Observation, tilt_deg
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.search.frame_search import vertical_of
from cliploc_ros.core.watch.camera import CameraTurn, ImageFaults, TurnEstimate
from cliploc_ros.core.watch.look import LookEvidence, align, by_vertical, look_at, measure
from cliploc_ros.errors import OptionsError
from cliploc_ros.units import NS_PER_S

# Tolerance for rounding of a given pose: a matrix farther from a rigid transform is refused.
_RIGID = 1e-3


class _Look(NamedTuple):
    observation: Observation
    log_odds: float
    is_full: bool  #: Whether a wrong pose would be noticed: enough objects and mapped objects


class Belief:
    """The Bayes filter. Looks must be added in the order of time."""

    def __init__(self) -> None:
        self._log_odds = 0.0
        self._looks: deque[_Look] = deque(maxlen=int(CALIBRATION.watch.most_looks))
        self._last: tuple[Observation, NDArray[np.float64]] | None = None
        #: Whether the localizer's pose has jumped since it was last found right
        self.has_jumped = False

    @property
    def probability(self) -> float:
        """Return the probability that the pose of the last look is right."""
        return 1.0 / (1.0 + math.exp(-self._log_odds))

    @property
    def against(self) -> int:
        """Return the number of recent full looks with evidence against the pose."""
        return sum(look.is_full and look.log_odds < 0.0 for look in self._looks)

    def wait(self, observation: Observation, map_from_camera: NDArray[np.float64]) -> None:
        """Predict: the time up to an observation passes, and the camera moves to a pose (4, 4)."""
        last, terms = self._last, CALIBRATION.watch
        self._last = observation, map_from_camera
        if last is None:
            return
        before, pose = last
        away_m, away_deg = 0.0, 0.0  # difference between the pose's motion and odometry
        if before.odom_from_camera is not None and observation.odom_from_camera is not None:
            away_m, away_deg = pose_error(pose @ invert_transform(
                before.odom_from_camera) @ observation.odom_from_camera, map_from_camera)
        if away_m > SAME_PLACE.distance_m or away_deg > SAME_PLACE.angle_deg:
            # If the looks had confirmed the previous pose, the new pose is probably wrong.
            self._log_odds = -min(max(self._log_odds, 0.0), terms.most_jump)
            self._looks.clear()
            self.has_jumped = True
            return
        time_s = max(0, observation.stamp_ns - before.stamp_ns) / NS_PER_S
        way_m = float(np.linalg.norm(map_from_camera[:3, 3] - pose[:3, 3]))
        keep = math.exp(-terms.lost_per_s * time_s - terms.lost_per_m * way_m)
        likely = 0.5 + keep * (self.probability - 0.5)
        self._log_odds = math.log(likely / (1.0 - likely))

    def add(self, observation: Observation, log_odds: float, is_full: bool) -> float:
        """Add a look after wait(); return its weight, 1 if it is independent of earlier looks."""
        look = _Look(observation, log_odds, is_full)
        weight = 1.0 - max((_correlation(earlier, look) for earlier in self._looks), default=0.0)
        self._log_odds += weight * log_odds
        self._looks.append(look)
        if self.probability > CALIBRATION.watch.localized:
            self.has_jumped = False
        return weight


def _correlation(earlier: _Look, look: _Look) -> float:
    """Return the correlation of the errors of two looks, 0 to 1."""
    terms = CALIBRATION.watch
    then, now = earlier.observation, look.observation
    if then.odom_from_camera is None or now.odom_from_camera is None:
        away = abs(now.stamp_ns - then.stamp_ns) / NS_PER_S / terms.correlated_s
    else:
        way_m, turn_deg = pose_error(then.odom_from_camera, now.odom_from_camera)
        away = way_m / terms.correlated_m + turn_deg / terms.correlated_deg
    # looks with contradictory evidence are not repetitions: the robot was carried away, or back
    return terms.correlated * math.exp(-away - abs(earlier.log_odds - look.log_odds) / terms.most)


class WatchState(StrEnum):
    """State of a localizer's pose."""

    LOCALIZED = 'localized'
    UNCERTAIN = 'uncertain'
    LOST = 'lost'


@dataclass(frozen=True)
class WatchReport:
    """The verdict of the watch after a look."""

    state: WatchState
    #: Probability that the localizer's pose is right (within 1 m and 45 degrees), after all looks,
    #: 0 to 1
    probability: float
    reason: str  #: One line: what happened, with which value, and what to do
    looks: int  #: Number of looks with evidence since the last forget()
    matched: int  #: Number of objects in the last look that are where the pose predicts them
    expected: int  #: Number of landmarks that the last look should have shown
    missing: tuple[str, ...] = ()  #: Landmarks that several looks should have shown but did not
    camera_turn: CameraTurn | None = None  #: None unless it is known and significant
    fault: str = ''  #: Fault of the images, such as 'the image is frozen'


class Watch:
    """Watches the poses of a localizer with one camera; not thread safe."""

    def __init__(self, relocalizer: Relocalizer) -> None:
        self._map = relocalizer.landmark_map
        self._options = replace(relocalizer.options, algorithm='auto', refine=True)
        self.forget()

    def forget(self) -> None:
        """Start over: the localizer was given another pose, time jumped, or the map changed."""
        self._belief, self._missing = Belief(), Missing(self._map)
        self._turn, self._faults = TurnEstimate(), ImageFaults()
        self._count, self._stamp_ns = 0, -1

    def look(self, observation: Observation, map_from_camera: NDArray[np.float64],
             image: NDArray[np.uint8] | None = None, recognizer: ImageRecognizer | None = None
             ) -> WatchReport:
        """Compare a camera's view with the expected view at the pose of a localizer.

        Parameters
        ----------
        observation : Observation
            Its odometry shows which looks are independent. Without odometry, time is used, and the
            probability converges more slowly.
        map_from_camera : ndarray (4, 4)
            The localizer's pose of the camera at the stamp of the image.
        image : ndarray (h, w, 3) of uint8, optional
            Needed to detect faults of the camera.
        recognizer : ImageRecognizer, optional
            Keyframe recognizer of the image.

        Raises
        ------
        OptionsError
            A pose is not a rigid transform, the image has no pixels, or the observation is
            invalid.
        """
        for name, pose in (('map_from_camera', map_from_camera),
                           ('odom_from_camera', observation.odom_from_camera)):
            if pose is not None and not is_rigid(pose, _RIGID):
                raise OptionsError(f'{name} is not a rigid transform: {np.asarray(pose).tolist()}')
        vertical_of(observation, self._options)  # raises OptionsError if invalid
        if image is not None and not image.size:
            raise OptionsError(f'image of shape {image.shape} has no pixels')
        if observation.stamp_ns < self._stamp_ns:
            self.forget()
        self._stamp_ns = observation.stamp_ns
        odom = observation.odom_from_camera
        fault = '' if image is None else self._faults.add(
            image, map_from_camera if odom is None else odom)
        if refused := too_tilted(tilt_deg(map_from_camera, observation.base_up_in_camera),
                                    self._options):
            fault = refused.reason
        self._belief.wait(observation, map_from_camera)
        return self._report(None if fault else self._weigh(
            observation, map_from_camera, recognizer), fault)

    def _weigh(self, observation: Observation, given: NDArray[np.float64],
               recognizer: ImageRecognizer | None) -> LookEvidence:
        """Add the evidence of a look at a given pose (4, 4)."""
        turn = self._turn.turn
        alignment = align(look_at(self._map, observation, self._options),
                          given if turn is None else given @ turn.stated_from_true)
        evidence, expected = measure(alignment)
        # where the map is out of date, unexplained objects are no evidence of a wrong pose
        is_full = evidence.is_full(self._belief.has_jumped) and (
            self._belief.has_jumped or not self._missing.is_outdated)
        odds = evidence.log_odds(is_full) + by_vertical(
            given, observation.up_in_camera, self._options.vertical_deviation_deg)
        if recognizer is not None:
            by_points = alignment.by_keyframes(recognizer, given)
            is_full |= by_points < CALIBRATION.watch.elsewhere
            odds += by_points
        if observation.tags is not None:
            by_tags = alignment.by_tags(given)
            is_full |= by_tags < CALIBRATION.watch.elsewhere
            odds += by_tags
        if odds == 0.0:
            return evidence
        self._count += 1
        weight = self._belief.add(observation, odds, is_full)
        if self._belief.probability > CALIBRATION.watch.localized:
            self._missing.add(expected, weight)
            self._turn.add(alignment, given, weight > CALIBRATION.watch.new_view)
        return evidence

    def _report(self, evidence: LookEvidence | None, fault: str) -> WatchReport:
        """Return the state, with a reason that says what happened and what to do."""
        terms, belief = CALIBRATION.watch, self._belief
        likely, state = belief.probability, WatchState.UNCERTAIN
        missing = tuple(self._map.landmark_ids[row] for row in self._missing.named())
        if likely > terms.localized and not self._missing.is_outdated:
            state = WatchState.LOCALIZED
        elif likely < terms.lost and belief.against >= (
                terms.against_jumped if belief.has_jumped else terms.against):
            state = WatchState.LOST
        reason = f'{state}: probability {likely:.2f}'
        seen = f'{evidence.matched} of {evidence.known} objects fit the pose' if evidence else ''
        if fault:
            reason += f'; {fault}; check the camera'
        elif state == WatchState.LOST:
            reason += f' that the pose is right; {seen}; relocalize'
        elif state == WatchState.LOCALIZED:
            reason += f'; {seen}'
        elif likely > terms.localized:
            reason += f'; {len(missing)} landmarks are missing here; update the map'
        else:
            reason += f'; {seen}; turn the camera to more objects'
        return WatchReport(state, likely, reason, self._count, evidence.matched if evidence else 0,
                           evidence.expected if evidence else 0, missing, self._turn.turn, fault)
