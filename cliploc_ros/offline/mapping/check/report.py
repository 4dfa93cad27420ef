# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The result of a check: figures, verdict and advice."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.keyframes.localization import keyframes_near
from cliploc_ros.offline.mapping.check import relocalization
from cliploc_ros.offline.mapping.check.findings import Grid, LandmarkCheck, LookAlike, Overlap
from cliploc_ros.offline.mapping.evidence import BoxQuality
from cliploc_ros.offline.mapping.options import Thresholds
from cliploc_ros.offline.mapping.systematic import Correction

#: If a map misses this measure alone, its verdict is "keyframes only".
BY_OBJECTS = 'positions with a heading accepted by objects alone'
#: A landmark of this severity has a serious fault.
SERIOUS = 1.0


class Advice(NamedTuple):
    """What to do, and the landmarks or view that show why."""

    text: str
    landmarks: tuple[str, ...] = ()  #: Ids of the landmarks that it concerns
    view: relocalization.Trial | None = None  #: The view that it concerns


class Measure(NamedTuple):
    """A figure of the map, and its threshold."""

    name: str
    value: float
    limit: float
    is_most: bool  #: The limit is the greatest allowed value; otherwise it is the least
    unit: Literal['share', 'number', 'count'] = 'share'

    @property
    def is_missed(self) -> bool:
        """Return whether the map misses the threshold."""
        return self.value > self.limit if self.is_most else self.value < self.limit

    def show(self, value: float) -> str:
        """Format a value, with enough digits to tell a missed value from its limit."""
        if self.unit != 'share':
            return f'{value:.4g}'
        told_apart = _percent(self.value, 2) != _percent(self.limit, 2)
        return _percent(value, 2 if told_apart or not self.is_missed else 4)


@dataclass(frozen=True)
class RecordingCheck:
    """The check of a map against a recording."""

    frames: int
    boxes: int
    duration_s: float
    path_xyz: NDArray[np.float64]  #: (F, 3): where the camera went [m]
    #: With the map as it is. A map built from this recording was fitted to these boxes.
    as_given: BoxQuality
    held_out: BoxQuality  #: Cross-validated over time
    #: Recorded frames in cross-validated maps, in the order of time
    trials: tuple[relocalization.Trial, ...]
    corrections: tuple[Correction, ...]

    @property
    def judged(self) -> tuple[relocalization.Trial, ...]:
        """Return the recorded frames by which the map can be judged."""
        return tuple(trial for trial in self.trials if trial.is_judged)

    @property
    def can_judge_frames(self) -> bool:
        """Return whether enough frames can be judged by cross-validation."""
        return 2 * len(self.judged) >= len(self.trials)

    @property
    def can_judge_boxes(self) -> bool:
        """Return whether other parts of the recording show the landmarks of most boxes, too."""
        return 2 * self.held_out.boxes >= self.as_given.boxes


@dataclass(frozen=True)
class GridCheck(Grid):
    """Relocalization over a grid of camera positions."""

    #: (P,): number of headings at each position with an accepted right pose, and a wrong pose
    accepted: NDArray[np.int64]
    misled: NDArray[np.int64]
    #: (P, H): average number of landmarks that the detector finds, by heading
    visible: NDArray[np.float64]
    trials: tuple[relocalization.Trial, ...]  #: Heading by heading of each position

    @property
    def headings(self) -> int:
        """Return the number of headings at each position."""
        return self.visible.shape[1]

    @property
    def useful(self) -> NDArray[np.int64]:
        """Return the number of headings (P,) that show enough landmarks for a pose."""
        return np.asarray((self.visible >= relocalization.LANDMARKS_FOR_A_POSE).sum(axis=1))

    @property
    def accepted_positions(self) -> float:
        """Return the share of the positions near the recording with an accepted heading."""
        near = self.accepted[self.is_near]
        return float((near > 0).mean()) if len(near) else 0.0


@dataclass(frozen=True)
class KeyframeCheck:
    """The coverage by the keyframes next to a map."""

    keyframes: int
    points: int
    #: (F,): recorded frames within reach of a keyframe; empty without a recording
    recorded: NDArray[np.bool_]
    headings: NDArray[np.int64]  #: (P,): number of headings within reach, by grid position
    without: NDArray[np.int64]  #: Rows of the positions near the recording without such a heading
    reached_positions: float  #: Share of the positions near the recording with such a heading


@dataclass(frozen=True)
class CheckReport:
    """The result of a check of a map."""

    landmarks: tuple[LandmarkCheck, ...]  #: The worst first
    overlaps: tuple[Overlap, ...]
    look_alikes: tuple[LookAlike, ...]
    grid: GridCheck
    recording: RecordingCheck | None = None
    measures: tuple[Measure, ...] = ()  #: The figures that determine the verdict
    to_do: tuple[Advice, ...] = ()  #: Advice, the most urgent first
    notes: tuple[str, ...] = ()  #: Assumptions behind the figures
    #: Coverage by the keyframes next to the map; None without keyframes
    keyframes: KeyframeCheck | None = None
    map_ids: tuple[str, ...] = ()  #: Ids in the map's order, which overlaps refer to
    #: Factor by which the map is too large, by the sizes of its objects; None if they fit
    scale: float | None = None

    @property
    def verdict(self) -> str:
        """Return 'passed', 'failed', or 'keyframes only' if only BY_OBJECTS is missed."""
        missed = [measure.name for measure in self.measures if measure.is_missed]
        return 'passed' if not missed else 'keyframes only' if missed == [BY_OBJECTS] else 'failed'

    @property
    def localized(self) -> tuple[str, ...]:
        """Return how many frames and positions localize a robot, by evidence, as sentences."""
        near, by_objects = self.grid.is_near, self.grid.accepted > 0
        reached = by_objects if self.keyframes is None else self.keyframes.headings > 0
        found = [_tell_localized('positions', by_objects[near], reached[near])]
        if self.recording is not None and (judged := self.recording.judged):
            found.insert(0, _tell_localized(
                'recorded frames',
                np.array([(trial.by_objects or trial.verdict) == 'accepted' for trial in judged]),
                np.array([trial.verdict == 'accepted' for trial in judged])))
        return tuple(found)

    @property
    def failures(self) -> tuple[str, ...]:
        """Return the thresholds that the map misses; empty if it is good enough."""
        return tuple(f'{measure.name}: {measure.show(measure.value)} '
                     f'{">" if measure.is_most else "<"} {measure.show(measure.limit)}'
                     for measure in self.measures if measure.is_missed)

    @property
    def advice(self) -> tuple[str, ...]:
        """Return advice, the most urgent first."""
        return tuple(one.text for one in self.to_do)

    @property
    def passed(self) -> bool:
        """Return whether the map reaches all thresholds."""
        return not self.failures

    @property
    def _by_images(self) -> list[relocalization.Trial]:
        """Return the recorded frames that were relocalized by keyframes, too."""
        return [] if self.recording is None else [
            trial for trial in self.recording.judged if trial.by_objects is not None]

    @property
    def evidence(self) -> str:
        """Describe the evidence by which poses are accepted."""
        return 'by objects or keyframes' if self.keyframes is not None and self._by_images else (
            'by objects')

    @property
    def accepted_positions(self) -> float:
        """Return the share of the grid positions near the recording with an accepted heading.

        If recorded images were relocalized by keyframes of other parts of the recording, a
        position with a keyframe within reach counts with the accepted share of these images.
        """
        if self.keyframes is None or not (by_images := self._by_images):
            return self.grid.accepted_positions
        near = self.grid.is_near
        chance = share(by_images, 'accepted') * (self.keyframes.headings[near] > 0)
        accepted = np.where(self.grid.accepted[near] > 0, 1.0, chance)
        return float(accepted.mean()) if len(accepted) else 0.0

    @property
    def duplicates(self) -> int:
        """Return the number of pairs of landmarks that are one object."""
        return sum(overlap.is_duplicate for overlap in self.overlaps)

    @property
    def faulty(self) -> float:
        """Return the share of the landmarks with a serious fault.

        Each landmark is weighted by its number of frames: a landmark of few frames will rarely be
        seen again.
        """
        return sum(landmark.weight for landmark in self.landmarks
                   if landmark.severity >= SERIOUS) / sum(
            landmark.weight for landmark in self.landmarks)


def _tell_localized(what: str, by_objects: NDArray[np.bool_], by_any: NDArray[np.bool_]) -> str:
    by_any = by_any | by_objects
    return (f'{len(by_any)} {what}: {by_objects.sum()} localized by objects, '
            f'{(by_any & ~by_objects).sum()} by keyframes only, {(~by_any).sum()} not localized')


def find_measures(report: CheckReport, limits: Thresholds) -> list[Measure]:
    """Return the figures of a report that have a threshold."""
    views, recording = [*report.grid.trials], report.recording
    measures = [
        Measure('landmarks with a serious fault', report.faulty, limits.max_faulty, True),
        Measure('pairs of duplicates', report.duplicates, limits.max_duplicates, True, 'count'),
        Measure('pairs of places that look alike', len(report.look_alikes),
                limits.max_look_alikes, True, 'count')]
    if recording is not None:
        views += recording.trials
        if recording.can_judge_boxes:
            measures += [Measure('held-out boxes explained', recording.held_out.explained,
                                 limits.min_explained, False),
                         Measure('held-out median IoU', recording.held_out.median_iou,
                                 limits.min_iou, False, 'number')]
        if recording.can_judge_frames:
            measures.append(Measure(f'recorded frames accepted {report.evidence}',
                                    share(recording.judged, 'accepted'), limits.min_accepted,
                                    False))
    if report.keyframes is not None and report.evidence != 'by objects':
        measures.append(Measure(BY_OBJECTS, report.grid.accepted_positions,
                                limits.min_by_objects, False))
    return [*measures,
            Measure(f'positions with a heading accepted {report.evidence}',
                    report.accepted_positions, limits.min_positions, False),
            Measure('views that mislead a robot', share(views, 'misled'), limits.max_misled, True)]


def _percent(value: float, digits: int) -> str:
    return np.format_float_positional(100.0 * value, digits, unique=False, fractional=False,
                                      trim='-') + ' %'


def share(trials: Sequence[relocalization.Trial], verdict: str) -> float:
    """Return the share of the trials with a verdict; 0 without trials."""
    return relocalization.count_verdicts(trials)[verdict] / len(trials) if trials else 0.0


def check_keyframes(layer: KeyframeLayer, grid: GridCheck,
                    recorded: NDArray[np.float64] | None) -> KeyframeCheck:
    """Return the coverage by keyframes; recorded (F, 4, 4) has the poses of a recording."""
    headings = in_reach(layer, grid.poses).reshape(grid.visible.shape).sum(axis=1)
    without = np.nonzero(grid.is_near & (headings == 0))[0]
    near = int(grid.is_near.sum())
    return KeyframeCheck(
        len(layer), int(layer.offsets[-1]),
        in_reach(layer, np.empty((0, 4, 4)) if recorded is None else recorded), headings,
        without, 1.0 - len(without) / near if near else 0.0)


def in_reach(layer: KeyframeLayer, poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask of the views of poses (n, 4, 4) that overlap the view of a keyframe."""
    return np.array([len(keyframes_near(layer.map_from_camera, pose)) > 0 for pose in poses],
                    dtype=np.bool_)
