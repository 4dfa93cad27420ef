# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The entry point of the watch: Watch.look(observation, map_from_camera) -> WatchReport."""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.geometry.transforms import is_rigid
from cliploc_ros.core.keyframes.localization import ImageRecognizer
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.search.frame_search import vertical_of
from cliploc_ros.core.watch.alignment import align, look_at
from cliploc_ros.core.watch.belief import Belief
from cliploc_ros.core.watch.camera_turn import CameraTurn, TurnEstimate
from cliploc_ros.core.watch.evidence import (
    LookEvidence,
    by_keyframes,
    by_vertical,
    log_odds,
    measure,
)
from cliploc_ros.core.watch.image_faults import ImageFaults
from cliploc_ros.core.watch.missing import Missing
from cliploc_ros.errors import OptionsError

# Looks against a pose that make it lost, no single one does: where odometry contradicts it, too,
# and where it does not.
_LEAST_AGAINST = {True: 2, False: 3}
# A look of more weight than this is at another view, see Belief.add.
_NEW_VIEW = 0.3
# Keyframes that say so much against a pose [log odds] recognize another place.
_ELSEWHERE = -3.0
_RIGID = 1e-3


class WatchState(StrEnum):
    """Whether a localizer's pose is right."""

    LOCALIZED = 'localized'
    UNCERTAIN = 'uncertain'
    LOST = 'lost'


@dataclass(frozen=True)
class WatchReport:
    """What the watch says after a look."""

    state: WatchState
    #: That the localizer's pose is right (within 1 m and 45 degrees), after all looks, 0 to 1
    probability: float
    reason: str  #: In one line: what happened, with which value, and what to do
    looks: int  #: Looks that said something since the last forget()
    matched: int  #: Objects of the last look that are where the pose expects them
    expected: int  #: Landmarks that the last look should have shown
    missing: tuple[str, ...] = ()  #: Landmarks that several looks expected and did not see
    camera_turn: CameraTurn | None = None  #: Once it is known and significant
    fault: str = ''  #: What is wrong with the images, such as 'the camera is covered'


class Watch:
    """Watches the poses of a localizer with one camera; not thread safe."""

    def __init__(self, relocalizer: Relocalizer) -> None:
        self._map = relocalizer.landmark_map
        self._options = replace(relocalizer.options, algorithm='auto', refine=True)
        self.forget()

    def forget(self) -> None:
        """Begin again: the localizer was given another pose, time jumped, or the map changed."""
        self._belief, self._missing = Belief(), Missing(self._map)
        self._turn, self._faults = TurnEstimate(), ImageFaults()
        self._count, self._stamp_ns = 0, -1

    def look(self, observation: Observation, map_from_camera: NDArray[np.float64],
             image: NDArray[np.uint8] | None = None, recognizer: ImageRecognizer | None = None
             ) -> WatchReport:
        """Compare what a camera sees with what it should see at the pose of a localizer.

        Parameters
        ----------
        observation : Observation
            Its odometry tells which looks are independent; without odometry the watch learns more
            slowly.
        map_from_camera : ndarray (4, 4)
            The localizer's pose of the camera at the stamp of the image.
        image : ndarray (h, w, 3) of uint8, optional
            To find faults of the camera.
        recognizer : ImageRecognizer, optional
            Of the keyframes, for this image.

        Raises
        ------
        OptionsError
            A pose is no rigid transform, the image has no pixels, or the observation is invalid.
        """
        for name, pose in (('map_from_camera', map_from_camera),
                           ('odom_from_camera', observation.odom_from_camera)):
            if pose is not None and not is_rigid(pose, _RIGID):
                raise OptionsError(f'{name} is no rigid transform: {np.asarray(pose).tolist()}')
        vertical_of(observation, self._options)  # refuses an invalid one
        if image is not None and not image.size:
            raise OptionsError(f'image of shape {image.shape} has no pixels')
        if observation.stamp_ns < self._stamp_ns:
            self.forget()
        self._stamp_ns = observation.stamp_ns
        odom = observation.odom_from_camera
        fault = '' if image is None else self._faults.add(
            image, map_from_camera if odom is None else odom)
        self._belief.wait(observation, map_from_camera)
        if fault:
            return self._report(None, fault)
        return self._report(self._weigh(observation, map_from_camera, recognizer))

    def _weigh(self, observation: Observation, given: NDArray[np.float64],
               recognizer: ImageRecognizer | None) -> LookEvidence:
        """Take in a look at a given pose (4, 4)."""
        turn = self._turn.turn
        alignment = align(look_at(self._map, observation, self._options),
                          given if turn is None else given @ turn.stated_from_true)
        evidence, expected = measure(alignment)
        # where the map is out of date, objects that nothing explains are no wrong pose
        is_full = evidence.is_full(self._belief.has_jumped) and (
            self._belief.has_jumped or not self._missing.is_outdated)
        odds = log_odds(evidence, is_full) + by_vertical(
            given, observation.up_in_camera, self._options.vertical_deviation_deg)
        if recognizer is not None:
            by_points = by_keyframes(recognizer, alignment, given)
            is_full |= by_points < _ELSEWHERE
            odds += by_points
        if odds == 0.0:
            return evidence
        self._count += 1
        weight = self._belief.add(observation, odds, is_full)
        if self._belief.probability > CALIBRATION.watch.localized:
            self._missing.add(expected, weight)
            self._turn.add(alignment, given, weight > _NEW_VIEW)
        return evidence

    def _report(self, evidence: LookEvidence | None, fault: str = '') -> WatchReport:
        terms, likely = CALIBRATION.watch, self._belief.probability
        state = WatchState.UNCERTAIN
        if likely > terms.localized and not self._missing.is_outdated:
            state = WatchState.LOCALIZED
        elif likely < terms.lost and (
                self._belief.against >= _LEAST_AGAINST[self._belief.has_jumped]):
            state = WatchState.LOST
        report = WatchReport(
            state, likely, '', self._count, evidence.matched if evidence else 0,
            evidence.expected if evidence else 0,
            tuple(self._map.landmark_ids[row] for row in self._missing.named()),
            self._turn.turn, fault)
        return replace(report, reason=_reason(report, evidence))


def _reason(report: WatchReport, evidence: LookEvidence | None) -> str:
    """Return what happened, with which value, and what to do."""
    head = f'{report.state}: probability {report.probability:.2f}'
    if report.fault:
        return f'{head}; {report.fault}; check the camera'
    assert evidence is not None
    seen = f'{evidence.matched} of {evidence.known} objects fit the pose'
    if report.state == WatchState.LOST:
        return f'{head} that the pose is right; {seen}; relocalize'
    if report.state == WatchState.LOCALIZED:
        return f'{head}; {seen}'
    if report.probability > CALIBRATION.watch.localized:
        return f'{head}; {len(report.missing)} landmarks are missing here; update the map'
    return f'{head}; {seen}; turn the camera to more objects'
