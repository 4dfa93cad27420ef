# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The files of a check: figures as JSON, and a page with the main results first.

Beside an advice are the room's own images: a landmark in its best view, or the nearest view.
"""

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from cliploc_ros.files.storage import write_text
from cliploc_ros.offline import page as html
from cliploc_ros.offline.evaluation.map_check.views import ViewPainter
from cliploc_ros.offline.mapping.check.landmark_faults import LandmarkCheck
from cliploc_ros.offline.mapping.check.relocalization import Trial, count_verdicts
from cliploc_ros.offline.mapping.check.report import (
    SERIOUS,
    Advice,
    CheckReport,
    Measure,
    RecordingCheck,
    count_by_objects,
    share,
)

PAGE, DATA = 'check.html', 'check.json'
LOOK_ALIKE = '#CC79A7'
VERDICT_COLORS = {'accepted': html.ACCEPTED, 'refused': html.REFUSED, 'misled': html.MISLED}
GRADE_COLORS = {'faulty': html.MISLED, 'minor': html.REFUSED, 'sound': '#009E73'}
GRADE_NAMES = {'faulty': 'serious fault', 'minor': 'minor fault', 'sound': 'sound'}
_MOST_LANDMARKS = 300
_MOST_MATCHED = 12
# Numbers and advice on the first screen.
_NUMBERS, FIRST_ADVICE = 3, 3
# How the names of figures for large type begin, the most telling first.
_TELLING = ('recorded frames accepted by', 'positions with a heading accepted',
            'views that mislead a robot', 'landmarks with a serious fault')


def grade(landmark: LandmarkCheck) -> str:
    """Return 'faulty', 'minor' or 'sound'."""
    if landmark.severity >= SERIOUS:
        return 'faulty'
    return 'minor' if landmark.faults else 'sound'


def write_report(folder: Path, name: str, report: CheckReport,
                 pictures: Iterable[tuple[str, str, bytes]], views: ViewPainter | None = None
                 ) -> None:
    """Write the page and the JSON file of a check of a named map, each in one step.

    Pictures have a name, a caption and a PNG each; the first one is on the first screen. Views are
    beside the advice. OptionsError: a file cannot be written; the old one stays.
    """
    data = _finite({'map': name, **report.as_dict()})
    write_text(folder / DATA, json.dumps(data, indent=1, allow_nan=False))
    write_text(folder / PAGE, _page(name, report, pictures, views))


def _finite(value: Any) -> Any:
    """Return a tree with null for numbers that JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _page(name: str, report: CheckReport, pictures: Iterable[tuple[str, str, bytes]],
          views: ViewPainter | None) -> str:
    missed = len(report.failures)
    said = html.verdict('The map reaches all thresholds.' if report.passed else
                        'Keyframes only: objects carry nothing.'
                        if report.verdict == 'keyframes only' else
                        f'The map misses {missed} of {len(report.measures)} thresholds.',
                        report.passed)
    said += html.items(f'Localized {one}' for one in report.carried)
    told = [one for name in _TELLING for one in report.measures if one.name.startswith(name)
            ][:_NUMBERS]
    first, *others = (html.figure(png, caption, picture) for picture, caption, png in pictures)
    cards = [_card(number, one, views) for number, one in enumerate(report.to_do, start=1)]
    parts = [html.first_screen(
        [said, html.tiles((one.show(one.value), one.name, not one.is_missed) for one in told),
         html.bars(_bar(measure) for measure in report.measures),
         '<h2>What to do first</h2>', *cards[:FIRST_ADVICE]], [first])]
    if rest := cards[FIRST_ADVICE:]:
        parts.append(html.fold(f'{len(rest)} more to do', *rest))
    faulty = sum(grade(landmark) == 'faulty' for landmark in report.landmarks)
    parts += [html.fold('All figures', html.table(('', ''), _figures(report))),
              html.fold('Pictures', *others),
              html.fold(f'Landmarks, worst first: {faulty} of {len(report.landmarks)} with a '
                        'serious fault', _landmarks(report.landmarks))]
    if report.look_alikes:
        parts.append(html.fold(f'{len(report.look_alikes)} pairs of places that look alike',
                               _look_alikes(report)))
    if report.recording is not None:
        rows = [(str(number), str(fold.frames), str(fold.landmarks), str(fold.boxes.boxes),
                 f'{fold.boxes.explained:.1%}', f'{fold.boxes.median_iou:.3f}')
                for number, fold in enumerate(report.recording.folds, start=1)]
        parts += [html.fold('Held-out boxes', html.note(
            'Blocks of time take turns in being judged; landmarks are fitted to the other '
            'blocks.'), html.table(('#fold', '#frames', '#landmarks', '#boxes', '#explained',
                                    '#median IoU'), rows)),
                  html.fold('Systematic residuals', _corrections(report.recording))]
    return html.page(f'Check of {name}', *parts,
                     html.fold('What these figures rest on', html.items(report.notes)))


def _card(number: int, advice: Advice, views: ViewPainter | None) -> str:
    view = None if views is None else views.of(advice)
    text = f'{number}. {advice.text}'
    return html.card(text) if view is None else html.card(text, view.jpeg, view.caption)


def _bar(one: Measure) -> html.Bar:
    """Return the bar of a figure; a count's bar has room for its limit and one more."""
    scale = max(one.limit + 1.0, one.value) if one.unit == 'count' else 1.0
    word = 'at most' if one.is_most else 'at least'
    return html.Bar(one.name, f'{one.show(one.value)} ({word} {one.show(one.limit)})',
                    one.value / scale, one.limit / scale, not one.is_missed)


def summary_lines(report: CheckReport) -> list[str]:
    """Return the figures as lines of text, for a terminal."""
    return [f'{name}: {value}' for name, value in _figures(report)]


def _figures(report: CheckReport) -> list[tuple[str, str]]:
    faulty = sum(grade(landmark) == 'faulty' for landmark in report.landmarks)
    rows = [('landmarks', str(len(report.landmarks))),
            ('with a serious fault', f'{faulty} ({report.faulty:.0%})'),
            ('pairs of duplicates', str(report.duplicates)),
            ('pairs of places that look alike', str(len(report.look_alikes)))]
    if (one := report.recording) is not None:
        rows += [
            ('recording', f'{one.frames} frames, {one.boxes} boxes, {one.duration_s:.0f} s'),
            ('explained boxes, median IoU; map as given',
             f'{one.as_given.explained:.1%}, {one.as_given.median_iou:.3f} (too good if the map '
             'was built from this recording)'),
            ('explained boxes, median IoU; held out',
             f'{one.held_out.explained:.1%}, {one.held_out.median_iou:.3f}'),
            (f'recorded frames, cross-validated, {report.evidence}', _verdicts(one.judged) + (
                '' if len(one.judged) == len(one.trials) else
                f'; of all {_verdicts(one.trials)}: no other part of the recording shows the '
                'objects of the rest')),
            *([('of these by objects alone', str(count_by_objects(one.judged)['accepted']))]
              if any(trial.by_objects for trial in one.trials) else []),
            ('the same poses with simulated boxes', _verdicts(one.simulated)),
            ('noise of box edges', f'{one.edge_scale:.2f} times that assumed by build_map')]
    if report.queries:
        rows.append(('queries with recorded similarities', _verdicts(report.queries)))
    near = ' near the recording' if report.recording else ''
    rows += [('grid views, by objects alone', _verdicts(report.grid.trials)),
             (f'grid positions{near} with a heading accepted by objects alone',
              f'{report.grid.accepted_positions:.0%} of {int(report.grid.is_near.sum())}')]
    if report.accepted_positions != report.grid.accepted_positions:
        rows.append((f'these positions, {report.evidence}', f'{report.accepted_positions:.0%}'))
    if (layer := report.keyframes) is not None:
        rows.append(('keyframes', f'{layer.keyframes} with {layer.points} points'))
        if len(layer.recorded):
            rows.append(('recorded frames within reach of a keyframe',
                         f'{layer.recorded.mean():.0%} of {len(layer.recorded)}'))
        rows.append(('grid positions within reach of a keyframe',
                     f'{layer.reached_positions:.0%} of {int(layer.grid.is_near.sum())}'))
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
    for one in landmarks[:_MOST_LANDMARKS]:
        support = '' if one.support is None else (
            str(one.support) if one.expected is None else f'{one.support} of {one.expected}')
        label = one.class_id if one.label == one.class_id else f'{one.label} ({one.class_id})'
        numbers = [(one.seen_ratio, 100.0, 0), (one.baseline_deg, 1.0, 0),
                   (one.position_sigma_m, 100.0, 1), (one.offset_m, 100.0, 1),
                   (one.median_iou, 1.0, 2), (one.thinness, 1.0, 2)]
        texts = [support, *('' if value is None else f'{value * factor:.{digits}f}'
                            for value, factor, digits in numbers)]
        faults = '; '.join(one.faults) if one.faults else GRADE_NAMES['sound']
        rows.append([
            (one.landmark_id, grade(one)), (label, 'text'), (faults, 'text'), *texts,
            ', '.join(f'{name} ({distance:.2f})' for name, distance in one.overlaps)])
    rest = len(landmarks) - _MOST_LANDMARKS
    more = html.note(f'and {rest} more in the JSON file') if rest > 0 else ''
    return html.table(head, rows) + more + html.note(
        'frames: with the landmark, of those that should show it. seen: their share. baseline: '
        'greatest angle between two views. deviation: of the centre on its worst axis. offset: '
        'from the centre to where its boxes put it. IoU: median of its boxes. thinness: least by '
        'greatest semi-axis. In brackets: the normalized distance of an overlap.')


def _look_alikes(report: CheckReport) -> str:
    rows = []
    for number, one in enumerate(report.look_alikes, start=1):
        pairs = ', '.join(f'{first} = {second}' for first, second in one.matched[:_MOST_MATCHED])
        if len(one.matched) > _MOST_MATCHED:
            pairs += f' and {len(one.matched) - _MOST_MATCHED} more'
        rows.append((str(number), f'{one.first[0]:.1f}, {one.first[1]:.1f}',
                     f'{one.second[0]:.1f}, {one.second[1]:.1f}', f'{one.turn_deg:.0f}',
                     f'{len(one.matched)} of {one.landmarks}', str(one.same_labels), pairs))
    return html.table(('#pair', 'a: x, y [m]', 'b: x, y [m]', '#turn [deg]', '#landmarks alike',
                       '#with equal labels', 'which'), rows)


def _corrections(recording: RecordingCheck) -> str:
    if not recording.corrections:
        return html.note('Too few boxes to tell.')
    rows = [(correction.cause, correction.name, f'{correction.value:+.2f} {correction.unit}',
             f'{correction.deviation:.2f} {correction.unit}', f'{correction.effect_px:.1f}',
             f'{correction.explained:.1%}', '' if not correction.is_significant else (
                 'may follow from the cause that explains most' if correction.follows
                 else 'significant'))
            for correction in recording.corrections]
    return (html.note('The correction that fits the edges of the boxes best, each cause on its '
                      'own. A turned mount and a shifted principal point look much the same.')
            + html.table(('cause', 'what', '#correction', '#deviation', '#effect [px]',
                          '#cost that the cause explains', ''), rows))
