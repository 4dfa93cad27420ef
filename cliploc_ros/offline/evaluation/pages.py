# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Write the page that compares methods, and page and figures of the check of a map.

Both begin with the main results. Each piece of advice on a map has an image of the recording: the
best view of a landmark, or the nearest view.
"""

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cliploc_ros.files.storage import write_text
from cliploc_ros.offline import page as html
from cliploc_ros.offline.evaluation.summary import Summary, find_best
from cliploc_ros.offline.mapping.check.findings import LandmarkCheck
from cliploc_ros.offline.mapping.check.relocalization import Trial, count_verdicts
from cliploc_ros.offline.mapping.check.report import (
    SERIOUS,
    Advice,
    CheckReport,
    Measure,
    count_by_objects,
    share,
)

COMPARISON = 'report.html'
CHECK, CHECK_DATA = 'check.html', 'check.json'
_TOP_VIEW = 'top_view'
# Columns of the table on the first screen: method, success, accepted, false accepts.
_BRIEF = (0, 1, 2, 5, 7)
CAPTIONS = {
    _TOP_VIEW: 'Top view of the map. A line joins each estimate of this method to the true pose.',
    'success_over_threshold': 'Share of poses, accepted or not, within a distance of the truth.',
    'precision_over_recall': 'Precision and recall for all thresholds of the confidence.',
    'best_iteration': 'Iteration that found the best pose.',
    'success_over_iterations': 'Success over the number of iterations.'}
#: Returns the JPEG and the caption of the image beside a piece of advice.
ViewOf = Callable[[Advice], tuple[bytes, str] | None]
#: Words and colour of each grade of a landmark.
GRADES = {'faulty': ('serious fault', html.MISLED), 'minor': ('minor fault', html.REFUSED),
          'sound': ('sound', '#009E73')}
_MOST_LANDMARKS = 300
# Numbers of figures and of pieces of advice on the first screen.
_NUMBERS, FIRST_ADVICE = 3, 3
# Beginnings of the names of figures in large type, the most important first.
_TELLING = ('recorded frames accepted by', 'positions with a heading accepted',
            'views that mislead a robot', 'landmarks with a serious fault')


# ---- methods ------------------------------------------------------------------------------------

def write_comparison(folder: Path, summaries: Sequence[Summary], rows: Sequence[Sequence[str]],
                     remarks: Sequence[str], pictures: Sequence[Path],
                     about: Sequence[tuple[str, str]]) -> None:
    """Write the page of `evaluate`. It embeds the pictures, which are PNG files.

    `rows` are those of the table, its header first; `about` names and values of input and options.
    """
    best = find_best(summaries)
    wrong, count = best.false_accepts(), best.errors_m.size
    said = html.verdict(f'{best.method} is the best of {len(summaries)} methods on '
                        f'{len(best.queries)} images' if len(summaries) > 1 else
                        f'{best.method} on {len(best.queries)} images', not wrong)
    numbers = [(f'{100 * best.success(1.0):.0f} %', 'of the poses within 1 m of the truth', True)]
    if not best.is_given:
        numbers += [
            (f'{int(best.accepted.sum())} of {count}', 'accepted', bool(best.accepted.any())),
            (str(wrong), 'accepted, but wrong by more than 1 m', not wrong)]
    drawn = {picture.stem: html.figure(picture.read_bytes(), CAPTIONS[picture.stem], picture.stem)
             for picture in pictures}
    head, *brief = [[row[column] for column in _BRIEF] for row in rows]
    top_view = drawn.pop(_TOP_VIEW, '')
    write_text(folder / COMPARISON, html.page(
        'Evaluation',
        html.first_screen([said, html.tiles(numbers), html.table(head, brief)], [top_view]),
        html.fold('Complete table', html.table(rows[0], rows[1:]), *map(html.note, remarks)),
        html.fold('Input and options', html.table(('', ''), about)),
        html.fold('Figures', html.side_by_side(drawn.values()), is_open=True)))


# ---- a map --------------------------------------------------------------------------------------

def write_check(folder: Path, name: str, report: CheckReport,
                pictures: Iterable[tuple[str, str, bytes]],
                view_of: ViewOf | None = None) -> None:
    """Write the page and the JSON file of the check of a map, each atomically.

    `pictures` have a name, a caption and a PNG. The first picture is on the first screen.
    OptionsError: a file cannot be written; the old file stays.
    """
    write_text(folder / CHECK_DATA, json.dumps(_plain({'map': name, **_data(report)}), indent=1,
                                               allow_nan=False))
    write_text(folder / CHECK, check_page(name, report, pictures, view_of))


def _data(report: CheckReport) -> dict[str, Any]:
    """Return the content of the JSON file."""
    grid, recording, layer = report.grid, report.recording, report.keyframes
    data = {
        'passed': report.passed, 'verdict': report.verdict, 'localized': report.localized,
        'scale_by_sizes': report.scale, 'failures': report.failures, 'advice': report.advice,
        'notes': report.notes, 'faulty_landmarks': report.faulty, 'duplicates': report.duplicates,
        'landmarks': report.landmarks, 'look_alikes': report.look_alikes,
        'overlaps': [{'first': report.map_ids[overlap.first],
                      'second': report.map_ids[overlap.second], 'distance': overlap.distance,
                      'is_duplicate': overlap.is_duplicate} for overlap in report.overlaps],
        'recording': None, 'keyframes': None,
        'grid': {**vars(grid), 'headings': grid.headings, 'poses': None,
                 'accepted_positions_near_recording': grid.accepted_positions,
                 'verdicts': count_verdicts(grid.trials),
                 'trials': [trial for trial in grid.trials if trial.verdict == 'misled']}}
    if recording is not None:
        data['recording'] = {
            **vars(recording), 'simulated': None, 'judged_frames': len(recording.judged),
            'verdicts': count_verdicts(recording.trials),
            'verdicts_by_objects': count_by_objects(recording.trials),
            'verdicts_with_simulated_boxes': count_verdicts(recording.simulated)}
    if layer is not None:
        data['keyframes'] = {
            'keyframes': layer.keyframes, 'points': layer.points,
            'recorded_frames_in_reach': layer.recorded.mean() if len(layer.recorded) else None,
            'positions_in_reach_near_recording': layer.reached_positions,
            'positions_without': grid.positions[layer.without]}
    return data


def _plain(value: Any) -> Any:
    """Return a value as a JSON tree: not finite numbers as None, trials without their results."""
    if is_dataclass(value):
        value = {key: item for key, item in vars(value).items()
                 if not (key == 'result' and isinstance(value, Trial))}
    if isinstance(value, np.ndarray | np.generic):
        value = value.round(4).tolist() if value.dtype.kind == 'f' else value.tolist()
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def grade(landmark: LandmarkCheck) -> str:
    """Return the grade of a landmark: 'faulty', 'minor' or 'sound'."""
    if landmark.severity >= SERIOUS:
        return 'faulty'
    return 'minor' if landmark.faults else 'sound'


def check_page(name: str, report: CheckReport, pictures: Iterable[tuple[str, str, bytes]],
               view_of: ViewOf | None = None) -> str:
    """Return the page of the check of a map, see write_check."""
    missed = len(report.failures)
    said = html.verdict('The map reaches all thresholds.' if report.passed else
                        'Keyframes only: the map misses the threshold for objects alone.'
                        if report.verdict == 'keyframes only' else
                        f'The map misses {missed} of {len(report.measures)} thresholds.',
                        report.passed)
    said += html.items(report.localized)
    told = [measure for name in _TELLING for measure in report.measures
            if measure.name.startswith(name)][:_NUMBERS]
    first, *others = (html.figure(png, caption, picture) for picture, caption, png in pictures)
    cards = [html.card(f'{number}. {advice.text}', *((view_of and view_of(advice)) or ()))
             for number, advice in enumerate(report.to_do, start=1)]
    parts = [html.first_screen(
        [said, html.tiles((measure.show(measure.value), measure.name, not measure.is_missed)
                          for measure in told),
         html.bars(_bar(measure) for measure in report.measures),
         '<h2>What to do first</h2>', *cards[:FIRST_ADVICE]], [first])]
    if later := cards[FIRST_ADVICE:]:
        parts.append(html.fold(f'{len(later)} more recommendations', *later))
    faulty = sum(grade(landmark) == 'faulty' for landmark in report.landmarks)
    parts += [html.fold('All figures', html.table(('', ''), _figures(report))),
              html.fold('Pictures', *others),
              html.fold(f'Landmarks, worst first: {faulty} of {len(report.landmarks)} with a '
                        'serious fault', _landmarks(report.landmarks))]
    if report.look_alikes:
        parts.append(html.fold(
            f'{len(report.look_alikes)} pairs of places that look alike', html.items(
                f'{number}: around x {pair.first[0]:.1f}, y {pair.first[1]:.1f} and x '
                f'{pair.second[0]:.1f}, y {pair.second[1]:.1f}, turned by {pair.turn_deg:.0f} '
                f'degrees; {len(pair.matched)} of {pair.landmarks} landmarks match, '
                f'{pair.same_labels} with equal labels: '
                + ', '.join(f'{first} = {second}' for first, second in pair.matched)
                for number, pair in enumerate(report.look_alikes, start=1))))
    return html.page(f'Check of {name}', *parts,
                     html.fold('How these figures were computed', html.items(report.notes)))


def _bar(measure: Measure) -> html.Bar:
    """Return the bar of a figure. That of a count ends at its limit plus one, or at its value."""
    scale = max(measure.limit + 1.0, measure.value) if measure.unit == 'count' else 1.0
    word = 'at most' if measure.is_most else 'at least'
    return html.Bar(
        measure.name, f'{measure.show(measure.value)} ({word} {measure.show(measure.limit)})',
        measure.value / scale, measure.limit / scale, not measure.is_missed)


def summary_lines(report: CheckReport) -> list[str]:
    """Return the figures as lines of text, for a terminal."""
    return [f'{name}: {value}' for name, value in _figures(report)]


def _figures(report: CheckReport) -> list[tuple[str, str]]:
    faulty = sum(grade(landmark) == 'faulty' for landmark in report.landmarks)
    rows = [('landmarks', str(len(report.landmarks))),
            ('with a serious fault', f'{faulty} ({report.faulty:.0%})'),
            ('pairs of duplicates', str(report.duplicates)),
            ('pairs of places that look alike', str(len(report.look_alikes)))]
    if (recording := report.recording) is not None:
        rows += [
            ('recording', f'{recording.frames} frames, {recording.boxes} boxes, '
             f'{recording.duration_s:.0f} s'),
            ('explained boxes, median IoU; map as given',
             f'{recording.as_given.explained:.1%}, {recording.as_given.median_iou:.3f} '
             '(optimistic if the map was built from this recording)'),
            ('explained boxes, median IoU; held out',
             f'{recording.held_out.explained:.1%}, {recording.held_out.median_iou:.3f}'),
            (f'recorded frames, cross-validated, {report.evidence}',
             _verdicts(recording.judged) + (
                 '' if len(recording.judged) == len(recording.trials) else
                 f'; of all frames {_verdicts(recording.trials)}: the objects of the other frames '
                 'are in no other part of the recording')),
            *([('accepted by objects alone', str(count_by_objects(recording.judged)['accepted']))]
              if any(trial.by_objects for trial in recording.trials) else []),
            ('the same poses with simulated boxes', _verdicts(recording.simulated)),
            ('noise of box edges', f'{recording.edge_scale:.2f} times that assumed by build_map')]
    near = ' near the recording' if report.recording else ''
    rows += [('grid views, by objects alone', _verdicts(report.grid.trials)),
             (f'grid positions{near} with a heading accepted by objects alone',
              f'{report.grid.accepted_positions:.0%} of {int(report.grid.is_near.sum())}')]
    if report.accepted_positions != report.grid.accepted_positions:
        rows.append((f'the same positions, {report.evidence}', f'{report.accepted_positions:.0%}'))
    if (layer := report.keyframes) is not None:
        rows.append(('keyframes', f'{layer.keyframes} with {layer.points} points'))
        if len(layer.recorded):
            rows.append(('recorded frames within reach of a keyframe',
                         f'{layer.recorded.mean():.0%} of {len(layer.recorded)}'))
        rows.append(('grid positions within reach of a keyframe',
                     f'{layer.reached_positions:.0%} of {int(report.grid.is_near.sum())}'))
    return rows


def _verdicts(trials: Sequence[Trial]) -> str:
    counts = count_verdicts(trials)
    accepted = share(trials, 'accepted')
    return (f'{counts["accepted"]} of {len(trials)} accepted ({accepted:.0%}), '
            f'{counts["refused"]} refused, {counts["misled"]} misled')


def _landmarks(landmarks: Sequence[LandmarkCheck]) -> str:
    head = ('landmark', 'label', 'faults', '#frames', '#seen [%]', '#baseline [°]',
            '#deviation [cm]', '#offset [cm]', '#IoU', '#thinness', 'overlaps with')
    rows: list[list[str | tuple[str, str]]] = []
    for check in landmarks[:_MOST_LANDMARKS]:
        support = '' if check.support is None else (
            str(check.support) if check.expected is None
            else f'{check.support} of {check.expected}')
        label = (check.class_id if check.label == check.class_id
                 else f'{check.label} ({check.class_id})')
        numbers = [(check.seen_ratio, 100.0, 0), (check.baseline_deg, 1.0, 0),
                   (check.position_sigma_m, 100.0, 1), (check.offset_m, 100.0, 1),
                   (check.median_iou, 1.0, 2), (check.thinness, 1.0, 2)]
        texts = [support, *('' if value is None else f'{value * factor:.{digits}f}'
                            for value, factor, digits in numbers)]
        faults = '; '.join(check.faults) if check.faults else GRADES['sound'][0]
        rows.append([
            (check.landmark_id, grade(check)), (label, 'text'), (faults, 'text'), *texts,
            ', '.join(f'{name} ({distance:.2f})' for name, distance in check.overlaps)])
    rest = len(landmarks) - _MOST_LANDMARKS
    more = html.note(f'{rest} more landmarks are in the JSON file') if rest > 0 else ''
    return html.table(head, rows) + more + html.note(
        'frames: number of frames with a detection of the landmark, of the frames that should '
        'show it. seen: their share. baseline: largest angle between two views. deviation: '
        'standard deviation of the centre along its worst axis. offset: distance between the '
        'centre and the centre of a fit to the boxes. IoU: median over the boxes. thinness: '
        'smallest semi-axis divided by the largest. In brackets: normalized distance of '
        'overlapping landmarks.')
