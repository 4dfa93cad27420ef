# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Advise how to improve a map, the most urgent advice first.

Causes come before their effects: a robot that is misled in a place that looks like another one
needs no separate advice.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from cliploc_ros.offline.mapping.check.places import RADIUS_M, LookAlike
from cliploc_ros.offline.mapping.check.relocalization import Trial, refused_spans
from cliploc_ros.offline.mapping.check.report import SERIOUS, Advice, CheckReport, GridCheck

_MOST_OF_A_KIND, _MOST_MISLED = 5, 3
# Shorter runs of refused frames, and smaller areas of the grid, get no advice.
_MIN_SPAN = 2
# Cosine of the angle between views of one side: 45 degrees, chosen.
_ONE_SIDE = 0.7
_FEW_LANDMARKS = 3
# More views are needed if landmarks have fewer frames (median) and more than this share of the
# boxes belongs to none. Chosen, between maps of fr3 from every 10th and from every 30th frame.
_FEW_FRAMES, _MANY_UNEXPLAINED = 12, 0.12
# Places nearer to each other are one place that looks the same from two sides [m]. Chosen.
_SAME_PLACE_M = 1.0
# The remedy for each cause of a systematic error of the boxes.
_REMEDIES = {
    'intrinsics': 'calibrate the camera and map again',
    'mount': 'measure how the camera is mounted on the robot',
    'stamps': 'check the clock and the delay of the images'}
# Distance from which a camera sees a place: twice the radius of a place [m].
_SIGHT_M = 2.0 * RADIUS_M


def give_advice(report: CheckReport) -> list[Advice]:
    """Return pieces of advice, each of one or two sentences."""
    recorded = report.recording.trials if report.recording else ()
    misled = [trial for trial in (*recorded, *report.grid.trials)
              if trial.verdict == 'misled']
    advice = [] if report.scale is None else [Advice(
        f'the map is about {max(report.scale, 1.0 / report.scale):.1f} times too '
        f'{"large" if report.scale > 1.0 else "small"} by the sizes of its objects: '
        'check the unit of the poses, then the intrinsics')]
    advice += _some([_on_look_alike(pair, misled) for pair in report.look_alikes],
                    'pairs of places that look alike')
    advice += [*_on_landmarks(report), *_on_corrections(report), *_on_misled(report, misled),
               *_on_spans(report, recorded), *_on_grid(report)]
    return advice or [Advice('nothing to do: the map reaches all thresholds that were checked')]


def _some(advice: Sequence[Advice], what: str) -> list[Advice]:
    """Return the first pieces of advice, and how many more there are."""
    more = len(advice) - _MOST_OF_A_KIND
    return [*advice[:_MOST_OF_A_KIND], *[Advice(f'and {more} more {what}')] * (more > 0)]


def _on_look_alike(pair: LookAlike, misled: Sequence[Trial]) -> Advice:
    matched = len(pair.matched)
    what_to_do = ('their labels are equal, so nothing tells them apart: map an object that '
                  'only one of them has') if pair.same_labels == matched else (
        f'{matched - pair.same_labels} labels differ: make sure that they are right')
    mistaken = sum(_sees_double(trial.position, [pair]) for trial in misled)
    alike = (f'the place around {_place(pair.first)} looks the same when turned by '
             f'{abs(pair.turn_deg):.0f} degrees'
             if np.hypot(*np.subtract(pair.first, pair.second)[:2]) < _SAME_PLACE_M else
             f'the places around {_place(pair.first)} and {_place(pair.second)} look alike')
    return Advice(f'{alike} ({matched} of {pair.landmarks} landmarks)'
                  + (f', {mistaken} views near them are misled' if mistaken else '')
                  + f': {what_to_do}', pair.matched[0] if pair.matched else ())


def _on_landmarks(report: CheckReport) -> Iterator[Advice]:
    """Yield advice on duplicates, on too few views, and on faults of single landmarks."""
    pairs = [(report.map_ids[overlap.first], report.map_ids[overlap.second])
             for overlap in report.overlaps if overlap.is_duplicate]
    yield from _some([Advice(f'{" and ".join(pair)} are the same object: delete one of them', pair)
                      for pair in pairs], 'pairs of duplicates')
    if report.recording is not None:
        frames = float(np.median([landmark.support or 0 for landmark in report.landmarks]))
        unexplained = 1.0 - report.recording.as_given.explained
        if frames < _FEW_FRAMES and unexplained > _MANY_UNEXPLAINED:
            yield Advice(
                f'record more views: of {report.recording.frames} frames, {frames:.0f} show a '
                f'landmark (median), and {unexplained:.0%} of the boxes belong to none; pass '
                f'all objects slowly, until {_FEW_FRAMES} frames or more show each of them')
    yield from _some([
        Advice(f'{one.landmark_id} {one.faults[0]}', (one.landmark_id,))
        for one in report.landmarks
        if one.severity >= SERIOUS and one.faults and 'same object as' not in one.faults[0]],
        'landmarks with a serious fault: record the place again, and update the map')


def _on_corrections(report: CheckReport) -> Iterator[Advice]:
    found = [result for result in (report.recording.corrections if report.recording else ())
             if result.is_significant]
    if not found:
        return
    # only one cause of one camera: its error makes other causes look wrong, too
    best = max(found, key=lambda result: result.explained)
    changes = ', '.join(
        f'{result.name} by {result.value:+.2f} {result.unit} (± {result.deviation:.2f})'
        for result in sorted(found, key=lambda result: -result.effect_px)
        if (result.cause, result.explained) == (best.cause, best.explained))
    others = sorted({result.cause for result in found} - {best.cause})
    then = f'; check again before you change the {" or the ".join(others)}' if others else ''
    yield Advice(f'{_REMEDIES[best.cause]}: the boxes fit better if you change {changes}{then}')


def _on_misled(report: CheckReport, misled: Sequence[Trial]) -> Iterator[Advice]:
    wrong = [trial for trial in misled if not _sees_double(trial.position, report.look_alikes)]
    for trial in sorted(wrong, key=lambda trial: -(trial.error_m or 0.0))[:_MOST_MISLED]:
        yield Advice(f'a robot at {_place(trial.position)} looking {_heading(trial)} would be '
                     f'misled by {trial.error_m:.1f} m: raise the parameter min_confidence, or '
                     'map more distinct objects there', view=trial)
    if len(wrong) > _MOST_MISLED:
        yield Advice(f'and {len(wrong) - _MOST_MISLED} more views that mislead a robot')


def _on_spans(report: CheckReport, trials: Sequence[Trial]) -> Iterator[Advice]:
    """Yield advice on runs of refused frames, once for each side of a place."""
    middles: list[Trial] = []
    for run in refused_spans(trials):
        middle, seen = run[len(run) // 2], int(np.median([trial.landmarks for trial in run]))
        if len(run) < _MIN_SPAN or middle.stamp_s is None or any(
                np.linalg.norm(middle.position - other.position) < RADIUS_M
                and middle.forward @ other.forward > _ONE_SIDE for other in middles):
            continue
        middles.append(middle)
        if len(middles) > _MOST_OF_A_KIND:
            return
        if seen <= _FEW_LANDMARKS or not _sees_double(middle.position, report.look_alikes):
            what = 'record this side' if seen <= _FEW_LANDMARKS else (
                'describe these objects better in their labels, or record this side again')
            yield Advice(
                f'{what}: {len(run)} frames at {middle.stamp_s - (trials[0].stamp_s or 0.0):.0f} '
                f's, around {_place(middle.position)} looking {_heading(middle)}, show {seen} '
                'landmarks and none is accepted', view=middle)


def _on_grid(report: CheckReport) -> Iterator[Advice]:
    """Yield advice on areas without an accepted heading, and on those without a keyframe."""
    grid, keyframes = report.grid, report.keyframes
    for rows in _areas(grid, np.nonzero(grid.is_near & (grid.accepted == 0))[0])[:_MOST_OF_A_KIND]:
        if np.mean([_sees_double(position, report.look_alikes)
                    for position in grid.positions[rows]]) <= 0.5:
            reached = keyframes is not None and (keyframes.headings[rows] > 0).all()
            yield Advice(
                f'no heading is accepted by objects at {_area(grid, rows)}'
                f'{", only keyframes reach them" if reached else ""}: a view from there shows '
                f'{int(grid.visible[rows].max())} landmarks at most; map more objects that can '
                'be seen from there',
                view=grid.trials[int(rows[0] * grid.headings + grid.visible[rows[0]].argmax())])
    if keyframes is not None:
        yield from _some([
            Advice(f'no keyframe is within reach of {_area(grid, rows)}: drive there when you '
                   'record again, or rely on the landmarks')
            for rows in _areas(grid, keyframes.without)], 'areas that no keyframe reaches')


def _sees_double(position: NDArray[np.float64], pairs: Sequence[LookAlike]) -> bool:
    """Return whether a camera is near a place that looks like another one."""
    return any(np.hypot(position[0] - place[0], position[1] - place[1]) < _SIGHT_M
               for pair in pairs for place in (pair.first, pair.second))


def _areas(grid: GridCheck, dead: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Group rows of a grid into areas of neighbours, the largest first."""
    if not len(dead):
        return []
    tree = cKDTree(grid.positions[dead])
    count, areas = connected_components(tree.sparse_distance_matrix(tree, 1.2 * grid.spacing_m))
    found = [dead[areas == number] for number in range(count)]
    return sorted((rows for rows in found if len(rows) >= _MIN_SPAN), key=len, reverse=True)


def _area(grid: GridCheck, rows: NDArray[np.int64]) -> str:
    low, high = grid.positions[rows].min(axis=0), grid.positions[rows].max(axis=0)
    return (f'{len(rows)} positions near the recording, x {low[0]:.1f} to {high[0]:.1f}, y '
            f'{low[1]:.1f} to {high[1]:.1f}')


def _place(point: NDArray[np.float64] | tuple[float, ...]) -> str:
    return f'x {point[0]:.1f}, y {point[1]:.1f}'


def _heading(trial: Trial) -> str:
    """Describe the heading of a camera as an angle from the map's x axis."""
    return f'to {np.degrees(np.arctan2(trial.forward[1], trial.forward[0])):.0f} degrees'
