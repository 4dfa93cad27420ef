# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The entry point of checking: a map and, if there is one, a recording in, a report out.

The report advises how to improve the map, the most urgent advice first. Causes come before their
effects: a robot that is misled in a place that looks like another one needs no separate advice.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import MappingError, counted
from cliploc_ros.offline.mapping.building import Progress
from cliploc_ros.offline.mapping.check import findings, relocalization
from cliploc_ros.offline.mapping.check.report import (
    SERIOUS,
    Advice,
    CheckReport,
    GridCheck,
    RecordingCheck,
    find_measures,
    in_reach,
)
from cliploc_ros.offline.mapping.evidence import BoxQuality, best_ious
from cliploc_ros.offline.mapping.options import CheckOptions, MappingOptions, Thresholds
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.mapping.systematic import find_corrections
from cliploc_ros.offline.mapping.tilt import tilt_note
from cliploc_ros.offline.mapping.views import Views, check_input, make_views
from cliploc_ros.offline.simulation import guess_detector
from cliploc_ros.offline.vocabulary.vocabulary import size_of_class

_NOTES = (
    'similarities of crops and labels are simulated: labels of equal text look equal, and labels '
    'that share words look alike',
    'the grid assumes that the map is correct, that walls hide only landmarks that were hidden in '
    'the recording, and that keyframes localize where they are within reach')
_NO_RECORDING = (
    'no recording: the detector is assumed to find 60 % of the objects in view within 5 m, in '
    'images of 640 x 480 px with a focal length of 525 px')
# Greatest difference in height between a robot's camera and those of the recording [m]. Chosen.
_HEIGHT_MARGIN_M = 0.3
# Least number of classes that agree about the scale of a map, up to a factor, which is also the
# least one reported: ellipsoids enclose objects loosely, or only parts of them. Chosen.
_LEAST_CLASSES, _OFF = 3, 1.8
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
_SIGHT_M = 2.0 * findings.RADIUS_M


def check_map(landmark_map: LandmarkMap, detections: PosedDetections | None = None,
              options: CheckOptions | None = None, thresholds: Thresholds | None = None,
              progress: Progress | None = None, layer: KeyframeLayer | None = None,
              image_of: relocalization.ImageOf | None = None) -> CheckReport:
    """Check a map.

    Parameters
    ----------
    detections : PosedDetections, optional
        A recording of the place. Without one, the report is shorter.
    thresholds : Thresholds, optional
        The thresholds that the map has to reach.
    layer : KeyframeLayer, optional
        The keyframes next to the map.
    image_of : callable, optional
        Returns the undistorted image (h, w, 3), RGB, of a frame of the recording; None if it is
        missing. With a layer, frames are relocalized by keyframes, too.

    Raises
    ------
    MappingError
        The map is empty, or the recording does not fit it; the message says what to correct.
    """
    if layer is None and not len(landmark_map):
        raise MappingError('the map has neither landmarks nor keyframes: build it again')
    options, tell = options or CheckOptions(), progress or (lambda stage, share: None)
    notes, views, witness, recording = [*_NOTES], None, None, None
    recorded = None if detections is None else detections.map_from_camera
    if detections is None:
        notes.append(_NO_RECORDING)
        model = guess_detector(landmark_map)
    else:
        tell('judging landmarks', 0.0)
        views = make_views(detections)
        notes += check_input(detections, views)
        witness = findings.hear_witness(views, landmark_map, detections.class_names)
        if len(landmark_map) and not (witness.shown >= 0).any():
            raise MappingError(_unrelated(landmark_map, detections))
        model = relocalization.measure_detector(landmark_map, detections, views, witness)
        if len(detections.cameras) > 1:
            notes.append(f'the grid uses one camera, {detections.camera_names[0]}, the first of '
                         f'{len(detections.cameras)}')
        recording = _check_recording(
            landmark_map, detections, views, witness, options, tell,
            None if layer is None or image_of is None else relocalization.RecordedKeyframes(
                layer, image_of))
    notes.append(_where_cameras_can_be(recorded))
    if layer is not None and len(layer.sources) > 1:
        counts = Counter(map(layer.recorded, range(len(layer))))
        notes.append('keyframes: ' + ', '.join(f'{counts[name]} of {name}' for name in counts))
    overlaps = findings.find_map_overlaps(landmark_map, witness, views)
    path = None if layer is None else layer.map_from_camera
    places = findings.make_grid(landmark_map, path if detections is None else
                                detections.map_from_camera[detections.frame_cameras == 0], options)
    trials = relocalization.try_poses(model, landmark_map, places.poses, options,
                                      partial(tell, 'relocalizing on the grid'))
    of_headings = -1, options.headings
    report = CheckReport(
        landmarks=tuple(findings.check_landmarks(landmark_map, witness, overlaps)),
        overlaps=tuple(overlaps), look_alikes=tuple(findings.find_look_alikes(landmark_map)),
        grid=GridCheck(**vars(places), trials=tuple(trials), by_objects=np.array(
            [trial.verdict == 'accepted' for trial in trials], dtype=np.bool_
        ).reshape(of_headings), by_keyframes=np.zeros(len(trials), dtype=np.bool_).reshape(
            of_headings) if layer is None else in_reach(layer, places.poses).reshape(of_headings)),
        recording=recording, notes=tuple(notes), map_ids=landmark_map.landmark_ids,
        keyframes=0 if layer is None else len(layer),
        tilt='' if recorded is None else tilt_note(recorded, not options.of_folder),
        scale=None if options.is_size_given else _scale_by_sizes(landmark_map))
    tell('done', 1.0)
    report = replace(report, measures=tuple(find_measures(report, thresholds or Thresholds())))
    return replace(report, to_do=tuple(give_advice(report, options.of_folder)))


def _check_recording(landmark_map: LandmarkMap, detections: PosedDetections, views: Views,
                     witness: findings.Witness, options: CheckOptions, tell: Progress,
                     keyframes: relocalization.RecordedKeyframes | None) -> RecordingCheck:
    tell('cross-validating', 0.0)
    folds, held_out = [], []
    for fold in relocalization.make_folds(detections, views, witness, options):
        # a box whose landmark no other view shows does not test the map
        is_known = (witness.shown < 0) | np.isin(witness.shown, fold.rows)
        ious = best_ious(views, fold.landmarks)[np.isin(views.frames, fold.frames) & is_known]
        folds.append(fold)
        held_out.append(ious)
        tell('cross-validating', len(folds) / options.folds)
    trials = relocalization.try_recording(landmark_map, detections, witness.shown, folds, options,
                                          partial(tell, 'relocalizing recorded frames'), keyframes)
    tell('looking for systematic errors', 0.0)
    return RecordingCheck(
        frames=len(detections), boxes=len(detections.classes),
        duration_s=float(detections.stamps_s[-1] - detections.stamps_s[0]),
        path_xyz=detections.map_from_camera[:, :3, 3],
        held_out=BoxQuality.of(np.concatenate(held_out)), trials=tuple(trials),
        corrections=tuple(find_corrections(detections, views, witness.fitted, witness.shown)),
        has_images=keyframes is not None)


def _where_cameras_can_be(recorded: NDArray[np.float64] | None) -> str:
    """Return a note on the range of accepted poses, given recorded poses (F, 4, 4)."""
    known = 'accepted poses may lie anywhere: the map does not limit where cameras can be'
    if recorded is None:
        return f'{known}, and there is no recording with their heights: set `height_range_m`'
    low, high = recorded[:, 2, 3].min(), recorded[:, 2, 3].max()
    return (f'{known}; recorded ones were {low:.2f} to {high:.2f} m high: set `height_range_m` to '
            f'[{low - _HEIGHT_MARGIN_M:.1f}, {high + _HEIGHT_MARGIN_M:.1f}] for their camera')


def _scale_by_sizes(landmark_map: LandmarkMap) -> float | None:
    """Estimate from the sizes of its objects by what factor a map is too large.

    The estimate is the median over classes of the median over their landmarks. Landmarks that were
    seen from one side only are ignored: they are longer towards the camera than their objects.
    None: the sizes fit, or too few classes agree about the factor.
    """
    ratios: dict[str, list[float]] = {}
    sides = [detail.baseline_deg for detail in landmark_map.details] or [None] * len(landmark_map)
    for name, semi_axes, seen_deg in zip(landmark_map.class_ids, landmark_map.semi_axes, sides,
                                         strict=True):
        size = size_of_class(name)
        if size is not None and (seen_deg is None or seen_deg >= MappingOptions.min_baseline_deg):
            ratios.setdefault(name, []).append(2.0 * semi_axes.max() / size.extent_m)
    scales = np.log([np.median(of_class) for of_class in ratios.values()])
    scale = float(np.median(scales)) if len(scales) else 0.0
    agree = (np.abs(scales - scale) < np.log(_OFF)) & (scales * np.sign(scale) > np.log(_OFF))
    return None if abs(scale) < np.log(_OFF) or agree.sum() < _LEAST_CLASSES else float(
        np.exp(scale))


def _unrelated(landmark_map: LandmarkMap, detections: PosedDetections) -> str:
    shared = set(landmark_map.class_ids) & set(detections.class_names)
    if not shared:
        return ('the recording has none of the classes of the map: use its detector, which finds '
                f'{", ".join(sorted(set(landmark_map.class_ids))[:3])}')
    return ('no box of the recording overlaps a landmark of its class: check that poses and map '
            'have the same coordinate frame, and that the poses are of the camera (z forward)')


def give_advice(report: CheckReport, of_folder: bool = False) -> list[Advice]:
    """Return pieces of advice, each of one or two sentences; of_folder: see CheckOptions."""
    recorded = report.recording.trials if report.recording else ()
    misled = [trial for trial in (*recorded, *report.grid.trials) if trial.verdict == 'misled']
    advice = [Advice('this map has no keyframes: build it again from all images')] * (
        report.recording is not None and not (report.keyframes or report.passed))
    advice += [Advice(report.tilt)] * bool(report.tilt)
    advice += [Advice('keyframes cannot be tried without the images of the recording: give them '
                      'to check_map with --images')] * report.lacks_images
    if report.scale is not None:
        advice.append(Advice(
            f'the map is about {max(report.scale, 1.0 / report.scale):.1f} times too '
            f'{"large" if report.scale > 1.0 else "small"} by the sizes of its objects: '
            'check the unit of the poses, then the intrinsics'))
    advice += [*_on_corrections(report, of_folder),
               *_some([_on_look_alike(pair, misled) for pair in report.look_alikes],
                      'pairs of places that look alike'), *_on_misled(report, misled)]
    advice += [Advice(
        f'objects alone localize {measure.part:.0f} of {measure.total:.0f} views: record more '
        'objects, each from several sides, for other light and moved furniture')
        for measure in report.measures
        if measure.key == 'min_by_objects' and measure.is_missed and report.keyframes]
    advice += [*_on_landmarks(report), *_on_spans(report, recorded), *_on_grid(report)]
    return advice or [Advice('nothing to do: the map reaches all thresholds' if report.passed else
                             'record the place again, with more views of its objects')]


def _some(advice: Sequence[Advice], what: str, most: int = _MOST_OF_A_KIND) -> list[Advice]:
    """Return the first pieces of advice, and how many more there are."""
    more = len(advice) - most
    return [*advice[:most], *[Advice(f'and {more} more of these: {what}')] * (more > 0)]


def _on_look_alike(pair: findings.LookAlike, misled: Sequence[relocalization.Trial]) -> Advice:
    matched = len(pair.matched)
    what_to_do = ('their labels are equal, so nothing tells them apart: map an object that '
                  'only one of them has') if pair.same_labels == matched else (
        f'{matched - pair.same_labels} labels differ: make sure that they are right')
    mistaken = sum(_sees_double(trial.position, [pair]) for trial in misled)
    alike = (f'the place around {_place(pair.first)} looks the same when turned by '
             f'{abs(pair.turn_deg):.0f} degrees'
             if np.hypot(*np.subtract(pair.first, pair.second)[:2]) < _SAME_PLACE_M else
             f'the places around {_place(pair.first)} and {_place(pair.second)} look alike')
    return Advice(f'{alike} ({matched} of {counted(pair.landmarks, "landmark")})'
                  + (f', where {counted(mistaken, "view")} would mislead' if mistaken else '')
                  + f': {what_to_do}', pair.matched[0] if pair.matched else ())


def _on_landmarks(report: CheckReport) -> Iterator[Advice]:
    """Yield advice on duplicates, on too few views, and on faults of single landmarks."""
    pairs = [(report.map_ids[overlap.first], report.map_ids[overlap.second])
             for overlap in report.overlaps if overlap.is_duplicate]
    yield from _some([Advice(f'{" and ".join(pair)} are the same object: delete one of them', pair)
                      for pair in pairs], 'pairs of duplicates')
    if report.recording is not None and report.landmarks:
        frames = float(np.median([landmark.support or 0 for landmark in report.landmarks]))
        unexplained = 1.0 - report.recording.held_out.explained
        if frames < _FEW_FRAMES and unexplained > _MANY_UNEXPLAINED:
            yield Advice(
                f'record more views: {frames:.0f} frames show a landmark (median), {_FEW_FRAMES} '
                f'should; {unexplained:.0%} of the boxes belong to none')
    yield from _some([
        Advice(f'{one.landmark_id} {one.faults[0]}', (one.landmark_id,))
        for one in report.landmarks
        if one.severity >= SERIOUS and one.faults and 'same object as' not in one.faults[0]],
        'landmarks with a serious fault: record the place again, and update the map')


def _on_corrections(report: CheckReport, of_folder: bool) -> Iterator[Advice]:
    found = [result for result in (report.recording.corrections if report.recording else ())
             if result.is_significant]
    # only one cause of one camera: its error makes other causes look wrong, too
    best = max(found, key=lambda result: result.explained, default=None)
    if best is None or (best.cause == 'mount' and of_folder):
        return
    changes = ', '.join(
        f'{result.name} by {result.value:+.2f} {result.unit} (± {result.deviation:.2f})'
        for result in sorted(found, key=lambda result: -result.effect_px)
        if (result.cause, result.explained) == (best.cause, best.explained))
    others = sorted({result.cause for result in found} - {best.cause, 'mount' * of_folder})
    then = f'; check again before you change the {" or the ".join(others)}' if others else ''
    yield Advice(f'{_REMEDIES[best.cause]}: the boxes fit better if you change {changes}{then}')


def _on_misled(report: CheckReport, misled: Sequence[relocalization.Trial]) -> list[Advice]:
    sources = ['objects' if trial.result is None else trial.result.source for trial in misled]
    by_keyframes = [trial for trial, source in zip(misled, sources, strict=True)
                    if source != 'objects']
    wrong = [trial for trial, source in zip(misled, sources, strict=True)
             if source == 'objects' and not _sees_double(trial.position, report.look_alikes)]
    advice = [Advice(f'keyframes mislead a robot in {counted(len(by_keyframes), "view")}: they '
                     'contradict the poses of the recording; build the map again',
                     view=by_keyframes[0])] if by_keyframes else []
    return advice + _some([
        Advice(f'a robot at {_place(trial.position)} looking {_heading(trial)} would be misled by '
               f'{trial.error_m:.1f} m: map more distinct objects there, or raise min_confidence',
               view=trial) for trial in sorted(wrong, key=lambda trial: -(trial.error_m or 0.0))],
        'views that mislead a robot', most=_MOST_MISLED)


def _on_spans(report: CheckReport, trials: Sequence[relocalization.Trial]) -> Iterator[Advice]:
    """Yield advice on runs of refused frames, once for each side of a place."""
    middles: list[relocalization.Trial] = []
    for run in relocalization.refused_spans(trials):
        middle, seen = run[len(run) // 2], int(np.median([trial.landmarks for trial in run]))
        if len(run) < _MIN_SPAN or middle.stamp_s is None or any(
                np.linalg.norm(middle.position - other.position) < findings.RADIUS_M
                and middle.forward @ other.forward > _ONE_SIDE for other in middles):
            continue
        middles.append(middle)
        if len(middles) > _MOST_OF_A_KIND:
            return
        if seen <= _FEW_LANDMARKS or not _sees_double(middle.position, report.look_alikes):
            what = 'record this side' if seen <= _FEW_LANDMARKS else (
                'describe these objects better in their labels, or record this side again')
            kind = middle.result and middle.result.refusal_kind
            why = f' ({kind.value.replace("_", " ")})' if kind else ''
            yield Advice(
                f'{what}: {len(run)} views at {middle.stamp_s - (trials[0].stamp_s or 0.0):.0f} '
                f's, around {_place(middle.position)} looking {_heading(middle)}, show '
                f'{counted(seen, "landmark")} and none is accepted{why}', view=middle)


def _on_grid(report: CheckReport) -> Iterator[Advice]:
    """Yield advice on areas without a heading that localizes a robot."""
    grid = report.grid
    is_dead = grid.is_near & (grid.localized == 0)
    for rows in _areas(grid, np.nonzero(is_dead)[0])[:_MOST_OF_A_KIND]:
        if np.mean([_sees_double(position, report.look_alikes)
                    for position in grid.positions[rows]]) <= 0.5:
            views = [grid.trials[row * grid.headings + heading]
                     for row in rows for heading in range(grid.headings)]
            best = max(views, key=lambda trial: trial.landmarks)
            yield Advice(f'no heading localizes a robot at {_area(grid, rows)}: the best view '
                         f'there shows {counted(best.landmarks, "landmark")}; drive there and map '
                         'more objects', view=best)


def _sees_double(position: NDArray[np.float64], pairs: Sequence[findings.LookAlike]) -> bool:
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
    return (f'{len(rows)} positions, x {low[0]:.1f} to {high[0]:.1f}, y {low[1]:.1f} to '
            f'{high[1]:.1f}')


def _place(point: NDArray[np.float64] | tuple[float, ...]) -> str:
    return f'x {point[0]:.1f}, y {point[1]:.1f}'


def _heading(trial: relocalization.Trial) -> str:
    """Describe the heading of a camera as an angle from the map's x axis."""
    return f'to {np.degrees(np.arctan2(trial.forward[1], trial.forward[0])):.0f} degrees'
