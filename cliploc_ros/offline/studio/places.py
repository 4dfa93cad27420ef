# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Coverage: places where a robot would be accepted, refused or misled, and look-alike places.

Both are computed as by check_map, but with fewer positions. The positions are in random order, so
that those tried before the time limit cover the whole map.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.mapping.check.checking import judge_grid
from cliploc_ros.offline.mapping.check.places import Grid, LookAlike, find_look_alikes, make_grid
from cliploc_ros.offline.mapping.check.relocalization import (
    Trial,
    count_verdicts,
    each_pose,
    measure_detector,
)
from cliploc_ros.offline.mapping.check.report import (
    GridCheck,
    KeyframeCheck,
    check_keyframes,
    tell_positions,
)
from cliploc_ros.offline.mapping.options import CheckOptions
from cliploc_ros.offline.simulation import DetectorModel, guess_detector
from cliploc_ros.offline.studio.landmark import Landmarks, map_of
from cliploc_ros.offline.studio.recording import Recording

#: No further position is tried after this time [s].
LIMIT_S = 60.0
_OPTIONS = CheckOptions(max_positions=100, headings=8)


class Coverage(NamedTuple):
    """The coverage and the look-alikes of a map."""

    landmarks: Landmarks  #: The landmarks that were checked
    grid: Grid  #: All positions; the tried positions are first
    check: GridCheck  #: Check of the tried positions
    look_alikes: tuple[LookAlike, ...]
    detector: str  #: Description of the source of the detector's errors
    keyframes: KeyframeCheck | None  #: Check of the tried positions; None without keyframes

    @property
    def figures(self) -> dict[str, str]:
        """The results by name."""
        verdicts, views = count_verdicts(self.check.trials), len(self.check.trials)
        return {'where a robot is localized': tell_positions(self.check, self.keyframes),
                'views accepted by objects': f'{verdicts["accepted"]} of {views}',
                'views misled': f'{verdicts["misled"]} of {views}',
                'pairs of places that look alike': str(len(self.look_alikes))}

    def lines(self, before: 'Coverage | None') -> list[str]:
        """Return the results as lines, with those of the previous search."""
        old = before.figures if before is not None else {}
        lines = [f'{name}: {value}' + (f' (was {old[name]})' if old else '')
                 for name, value in self.figures.items()]
        if len(self.check.positions) < len(self.grid.positions):
            lines.append(f'time is up: {len(self.check.positions)} of '
                         f'{len(self.grid.positions)} positions were tried')
        return [*lines, f'{self.detector}; similarities are simulated']


def find_places(landmarks: Landmarks, recording: Recording | None, before: Coverage | None,
                tell: Callable[[float], None], limit_s: float = LIMIT_S,
                layer: KeyframeLayer | None = None) -> Coverage:
    """Return the places of a map where a robot would be accepted, refused or misled.

    Camera height and detector errors come from the recording. The positions of the previous
    search are reused if they still cover the map, so that only edits change the results. ``tell``
    is called with the completed share; an error that it raises ends the search. No position is
    begun after ``limit_s``. MapError: there are no landmarks.
    """
    tell(0.0)
    landmark_map = map_of(landmarks)
    model, detector = _detector(landmark_map, recording)
    grid = _grid(landmark_map, recording, before)
    trials: list[Trial] = []
    begin = time.monotonic()
    for trial in each_pose(model, landmark_map, grid.poses, _OPTIONS):
        if not trials:
            begin = time.monotonic()  # the first trial may have compiled kernels
        trials.append(trial)
        tell(len(trials) / len(grid.poses))
        is_whole = len(trials) % _OPTIONS.headings == 0
        if is_whole and time.monotonic() - begin > limit_s:
            break
    check = judge_grid(grid, model, trials, _OPTIONS.headings)
    return Coverage(landmarks, grid, check, tuple(find_look_alikes(landmark_map)), detector,
                    None if layer is None else check_keyframes(layer, check, None))


def _detector(landmark_map: LandmarkMap, recording: Recording | None
              ) -> tuple[DetectorModel, str]:
    """Return the detector of a recording, else an assumed detector, and its description."""
    guess = guess_detector(landmark_map)
    if recording is None:
        return guess, 'without a recording, camera and detector are assumed'
    detections = recording.detections
    if len(detections.classes):
        witness = recording.witness(landmark_map)
        if (witness.shown >= 0).any():
            return measure_detector(landmark_map, detections, recording.views, witness
                                    ), 'the errors of the detector are those of the recording'
    return (replace(guess, camera=detections.cameras[0]),
            'no box of the recording shows a landmark: the detector is assumed')


def _grid(landmark_map: LandmarkMap, recording: Recording | None, before: Coverage | None) -> Grid:
    """Return positions all over the map; reuse the previous positions if their corners agree."""
    poses = None if recording is None else recording.detections.of_first_camera
    grid = make_grid(landmark_map, poses, _OPTIONS)
    if before is not None and len(grid.positions) and len(before.grid.positions):
        offset_m = max(np.abs(corner(grid.positions, axis=0)
                              - corner(before.grid.positions, axis=0)).max()
                       for corner in (np.min, np.max))
        if offset_m <= grid.spacing_m:
            return before.grid
    order = np.random.default_rng(_OPTIONS.random_seed).permutation(len(grid.positions))
    by_position = grid.poses.reshape(len(order), _OPTIONS.headings, 4, 4)
    return Grid(grid.positions[order], grid.is_near[order],
                by_position[order].reshape(-1, 4, 4), grid.spacing_m)
