# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The result of a check: figures, verdict and advice."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, get_type_hints

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.keyframes.localization import keyframes_near
from cliploc_ros.errors import counted
from cliploc_ros.offline.mapping.check import relocalization
from cliploc_ros.offline.mapping.check.findings import Grid, LandmarkCheck, LookAlike, Overlap
from cliploc_ros.offline.mapping.evidence import BoxQuality
from cliploc_ros.offline.mapping.options import Thresholds
from cliploc_ros.offline.mapping.systematic import Correction

#: A landmark of this severity has a serious fault.
SERIOUS = 1.0
#: The measures, by the names of their thresholds.
MEASURES = {name: hint.__metadata__[0]
            for name, hint in get_type_hints(Thresholds, include_extras=True).items()}
#: The thresholds that each verdict needs, and what a robot gets; the first reached one counts.
VERDICTS = {
    'passed': (('min_localized', 'min_by_objects', 'max_misled', 'max_systematic'),
               'a robot is localized, by objects also in other light or among moved furniture'),
    'keyframes only': (('min_by_keyframes', 'max_misled', 'max_systematic'),
                       'a robot is localized while light and furniture are as recorded'),
    'not judged by keyframes': (
        ('max_misled', 'max_systematic'),
        'objects alone localize too few views; keyframes need the images of the recording'),
    'failed': ((), 'a robot is mostly refused, misled, or localized with a bias')}
# What misses a threshold, as a clause about a part of the views.
_CLAUSES = {
    'min_localized': '{} views are localized', 'min_by_objects': 'objects alone localize {} views',
    'min_by_keyframes': 'keyframes alone localize {} views',
    'max_misled': 'a wrong pose is accepted in {} recorded and simulated views',
    'max_systematic': 'a wrong camera, mount or clock explains errors of boxes'}


class Advice(NamedTuple):
    """What to do, and the landmarks or view that show why."""

    text: str
    landmarks: tuple[str, ...] = ()  #: Ids of the landmarks that it concerns
    view: relocalization.Trial | None = None  #: The view that it concerns


class Measure(NamedTuple):
    """A part of the views, and the threshold of its share."""

    key: str  #: Of MEASURES
    part: float
    total: float
    limit: float

    @property
    def share(self) -> float:
        """Return the share of the part, 0 to 1."""
        return self.part / self.total if self.total else 0.0

    @property
    def is_missed(self) -> bool:
        """Return whether the map misses the threshold."""
        return self.share > self.limit if self.key.startswith('max') else self.share < self.limit

    def __str__(self) -> str:
        """Describe the figure and its threshold, with the digits that tell them apart."""
        word = 'at most' if self.key.startswith('max') else 'at least'
        text = f'{self._percent(self.share)}, {word} {self._percent(self.limit)}'
        return text if self.total == 1.0 else f'{self.part:.0f} of {self.total:.0f} ({text})'

    @property
    def clause(self) -> str:
        """Describe what misses the threshold, in a clause."""
        word = 'at most {} allowed' if self.key.startswith('max') else '{} needed'
        return (_CLAUSES[self.key].format(f'{self.part:.0f} of {self.total:.0f}')
                + f' ({self._percent(self.share)}; {word.format(self._percent(self.limit))})')

    def _percent(self, share: float) -> str:
        """Return a share with the digits that tell it from 0 and the share from its limit."""
        is_near = self.is_missed and abs(self.share - self.limit) < 0.01
        digits = int(is_near or 0.0 < self.share < 0.005)
        return f'{share:.{digits}%}'


@dataclass(frozen=True)
class RecordingCheck:
    """The check of a map against a recording."""

    frames: int
    boxes: int
    duration_s: float
    path_xyz: NDArray[np.float64]  #: (F, 3): where the camera went [m]
    held_out: BoxQuality  #: Cross-validated
    #: Recorded frames in cross-validated maps, in the order of time
    trials: tuple[relocalization.Trial, ...]
    corrections: tuple[Correction, ...]
    has_images: bool  #: Whether the trials use keyframes


@dataclass(frozen=True)
class GridCheck(Grid):
    """Relocalization over a grid of camera positions: P positions with H headings."""

    #: (P, H): headings with an accepted right pose by objects, and within reach of a keyframe
    by_objects: NDArray[np.bool_]
    by_keyframes: NDArray[np.bool_]
    trials: tuple[relocalization.Trial, ...]  #: By objects, heading by heading of each position

    @property
    def headings(self) -> int:
        """Return the number of headings at each position."""
        return self.by_objects.shape[1]

    @property
    def localized(self) -> NDArray[np.int64]:
        """Return the number of headings (P,) that localize a robot, by objects or keyframes."""
        return np.asarray((self.by_objects | self.by_keyframes).sum(axis=1))


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
    tilt: str = ''  #: A remark on the vertical of the map, if it seems wrong
    keyframes: int = 0  #: Number of keyframes next to the map
    map_ids: tuple[str, ...] = ()  #: Ids in the map's order, which overlaps refer to
    #: Factor by which the map is too large, by the sizes of its objects; None if they fit
    scale: float | None = None

    @property
    def verdict(self) -> str:
        """Return the first of VERDICTS whose thresholds are reached."""
        reached = {measure.key for measure in self.measures if not measure.is_missed}
        return next(name for name, (needed, _) in VERDICTS.items() if reached >= {*needed} and (
            self.lacks_images or name != 'not judged by keyframes'))

    @property
    def lacks_images(self) -> bool:
        """Return whether recorded views are judged by objects only, for want of images."""
        return bool(self.keyframes and self.recording and not self.recording.has_images)

    @property
    def summary(self) -> tuple[str, ...]:
        """Return the verdict and the figures behind it, as sentences."""
        why = '; not `passed`: ' + ', '.join(self.failures) if self.failures else ''
        return f'{self.verdict}: {VERDICTS[self.verdict][1]}{why}', *self.localized

    @property
    def localized(self) -> tuple[str, ...]:
        """Return how many recorded views and grid positions localize a robot, as sentences."""
        near, found, misled = self.grid.is_near, [], ''
        if self.recording is not None:
            trials = self.recording.trials
            counts = relocalization.count_verdicts(trials)
            alone = f'{sum(trial.by_objects for trial in trials)} by objects alone'
            if self.keyframes:
                both = sum(trial.verdict == 'accepted' and not (
                    trial.by_objects or trial.by_keyframes) for trial in trials)
                alone += (f', {sum(trial.by_keyframes for trial in trials)} by keyframes alone'
                          + f', {both} only by both' * bool(both)
                          if self.recording.has_images else
                          ', keyframes not tried without images')
            found.append(
                f'{counted(len(trials), "recorded view")}, each in a map of the other views: '
                f'{counts["accepted"]} localized ({alone}{_errors(trials)}), '
                f'{counts["refused"]} refused')
            misled = f'{counts["misled"]} of {len(trials)} recorded and '
        of_objects, of_keyframes = (int(headings.any(axis=1)[near].sum()) for headings in (
            self.grid.by_objects, self.grid.by_keyframes))
        where = '' if near.all() else ' near the recorded views'
        found.append(
            f'{counted(int(near.sum()), "position")}{where}: '
            f'{int((self.grid.localized[near] > 0).sum())} with a heading that localizes '
            f'({of_objects} by simulated objects'
            + (f', {of_keyframes} within reach of a keyframe)' if self.keyframes else ')'))
        simulated = relocalization.count_verdicts(self.grid.trials)['misled']
        found[-1] += f'; {misled}{simulated} of {len(self.grid.trials)} simulated views misled'
        return tuple(found)

    @property
    def failures(self) -> tuple[str, ...]:
        """Return the thresholds that the map misses; empty if it is good enough."""
        return tuple(measure.clause for measure in self.measures
                     if measure.is_missed and measure.key in VERDICTS['passed'][0])

    @property
    def advice(self) -> tuple[str, ...]:
        """Return advice, the most urgent first."""
        return tuple(one.text for one in self.to_do)

    @property
    def passed(self) -> bool:
        """Return whether the map reaches all thresholds."""
        return self.verdict == 'passed'

    @property
    def duplicates(self) -> int:
        """Return the number of pairs of landmarks that are one object."""
        return sum(overlap.is_duplicate for overlap in self.overlaps)


def _errors(trials: Sequence[relocalization.Trial]) -> str:
    """Return the median and the greatest error of localized views; '' without such a view."""
    begin_s = trials[0].stamp_s or 0.0 if trials else 0.0
    errors = [(trial.error_m or 0.0, (trial.stamp_s or 0.0) - begin_s) for trial in trials
              if trial.verdict == 'accepted']
    if not errors:
        return ''
    worst_m, stamp_s = max(errors)
    return (f'; error {np.median([error_m for error_m, _ in errors]):.2f} m (median), '
            f'{worst_m:.2f} m at most, at {stamp_s:.0f} s')


def find_measures(report: CheckReport, limits: Thresholds) -> list[Measure]:
    """Return the figures of a report that have a threshold.

    Without a recording, the positions near the keyframes are counted in place of recorded views.
    Views by keyframes are left out where there are no keyframes, or no images to try them.
    """
    grid, recording = report.grid, report.recording
    if recording is None:
        columns = (grid.localized, grid.by_objects.any(axis=1), grid.by_keyframes.any(axis=1))
        total, counts = int(grid.is_near.sum()), [
            int((column[grid.is_near] > 0).sum()) for column in columns]
    else:
        total, counts = len(recording.trials), [
            sum(trial.verdict == 'accepted' for trial in recording.trials),
            sum(trial.by_objects for trial in recording.trials),
            sum(trial.by_keyframes for trial in recording.trials)]
    views = [*grid.trials, *(recording.trials if recording else ())]
    systematic = max((result.explained for result in (recording.corrections if recording else ())
                      if result.is_significant), default=0.0)
    parts = [*((float(count), float(total)) for count in counts),
             (float(sum(trial.verdict == 'misled' for trial in views)), float(len(views))),
             (systematic, 1.0)]
    return [Measure(key, part, whole, getattr(limits, key))
            for key, (part, whole) in zip(MEASURES, parts, strict=True)
            if key != 'min_by_keyframes' or (report.keyframes and not report.lacks_images)]


def in_reach(layer: KeyframeLayer, poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask of the views of poses (n, 4, 4) that overlap the view of a keyframe."""
    return np.array([len(keyframes_near(layer.map_from_camera, pose)) > 0 for pose in poses],
                    dtype=np.bool_)
