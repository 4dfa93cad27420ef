# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The entry point of the watch: Watch.look(observation, map_from_camera) -> WatchReport."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.geometry.transforms import is_rigid
from cliploc_ros.core.keyframes.localization import ImageRecognizer
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.core.watch.alignment import align, look_at
from cliploc_ros.core.watch.belief import Belief
from cliploc_ros.core.watch.camera_turn import CameraTurn
from cliploc_ros.core.watch.evidence import (
    LookEvidence,
    by_keyframes,
    by_vertical,
    log_odds,
    measure,
)
from cliploc_ros.core.watch.missing import Missing
from cliploc_ros.errors import OptionsError


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
        self._relocalizer = relocalizer
        self.forget()

    def forget(self) -> None:
        """Begin again: the localizer was given another pose, time jumped, or the map changed."""
        self._belief, self._missing, self._count = Belief(), Missing(), 0

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
            A pose is no rigid transform, or the observation is invalid.
        """
        _check(observation, map_from_camera)
        alignment = align(look_at(self._relocalizer.landmark_map, observation,
                                  self._relocalizer.options), map_from_camera)
        evidence, expected = measure(alignment)
        odds = log_odds(evidence) + by_vertical(map_from_camera, observation.up_in_camera,
                                                self._relocalizer.options.vertical_deviation_deg)
        if recognizer is not None:
            odds += by_keyframes(recognizer, alignment, map_from_camera)
        self._belief.wait(observation, map_from_camera)
        if odds:
            self._count += 1
            self._belief.add(observation, map_from_camera, odds, evidence.known)
        if evidence.matched >= 2 and self._belief.probability > CALIBRATION.watch.localized:
            self._missing.add(expected, 1.0)
        return self._report(evidence)

    def _report(self, evidence: LookEvidence) -> WatchReport:
        terms, likely = CALIBRATION.watch, self._belief.probability
        missing = tuple(self._relocalizer.landmark_map.landmark_ids[row]
                        for row in self._missing.named())
        state = WatchState.UNCERTAIN
        if likely > terms.localized:
            state = WatchState.LOCALIZED
        elif likely < terms.lost and self._belief.against >= 2:
            state = WatchState.LOST
        return WatchReport(state, likely, _reason(state, likely, evidence), self._count,
                           evidence.matched, evidence.expected, missing)


def _check(observation: Observation, map_from_camera: NDArray[np.float64]) -> None:
    if not is_rigid(map_from_camera, 1e-3):
        raise OptionsError(f'map_from_camera is no rigid transform: {map_from_camera.tolist()}')
    odom = observation.odom_from_camera
    if odom is not None and not is_rigid(odom, 1e-3):
        raise OptionsError(f'odom_from_camera is no rigid transform: {odom.tolist()}')


def _reason(state: WatchState, likely: float, evidence: LookEvidence) -> str:
    seen = f'{evidence.matched} of {evidence.known} objects are where the pose expects them'
    if state == WatchState.LOST:
        return f'lost: probability {likely:.2f}; {seen}; relocalize'
    if state == WatchState.LOCALIZED:
        return f'localized: probability {likely:.2f}; {seen}'
    return f'uncertain: probability {likely:.2f}; {seen}; turn the camera to more objects'
