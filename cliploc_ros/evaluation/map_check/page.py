# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The files of a check: figures as JSON; a page with pictures, no scripts, no requests."""

import json
import math
from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

from cliploc_ros.files.storage import write_text
from cliploc_ros.mapping.check.landmark_faults import LandmarkCheck
from cliploc_ros.mapping.check.relocalization import Trial, count_verdicts
from cliploc_ros.mapping.check.report import (
    SERIOUS,
    CheckReport,
    RecordingCheck,
    count_by_objects,
    share,
)

PAGE, DATA = 'check.html', 'check.json'
ACCEPTED, REFUSED, MISLED = '#0072B2', '#E69F00', '#D55E00'
SOUND, MINOR, FAULTY = '#009E73', '#E69F00', '#D55E00'
LOOK_ALIKE, INK, FAINT = '#CC79A7', '#222222', '#999999'
VERDICT_COLORS = {'accepted': ACCEPTED, 'refused': REFUSED, 'misled': MISLED}
GRADE_COLORS = {'faulty': FAULTY, 'minor': MINOR, 'sound': SOUND}
GRADE_NAMES = {'faulty': 'serious fault', 'minor': 'minor fault', 'sound': 'sound'}
_MOST_LANDMARKS = 300
_MOST_MATCHED = 12
_STYLE = f"""\
body {{ font: 16px/1.5 system-ui, sans-serif; color: #222; margin: 2rem auto; max-width: 1200px;
  padding: 0 1rem }}
img {{ max-width: 100%; border: 1px solid #ddd }}
table {{ border-collapse: collapse; font-size: 14px; font-variant-numeric: tabular-nums;
  margin: 1rem 0 }}
th, td {{ text-align: left; vertical-align: top; padding: .25rem .7rem;
  border-bottom: 1px solid #ddd; unicode-bidi: isolate }}
td {{ min-width: 6rem; max-width: 24rem; overflow-wrap: anywhere }}
td.text {{ min-width: 11rem }}
td.number, th.number {{ text-align: right; min-width: 0 }} td.number {{ white-space: nowrap }}
li, h1, figcaption {{ overflow-wrap: anywhere; unicode-bidi: isolate }}
.scroll {{ overflow-x: auto }}
.verdict {{ border-left: 6px solid; padding: .6rem 1rem; background: #f6f6f6 }}
.passed {{ border-color: {ACCEPTED} }} .failed {{ border-color: {FAULTY} }}
.faulty {{ border-left: 4px solid {FAULTY} }} .minor {{ border-left: 4px solid {MINOR} }}
.note, figcaption {{ font-size: 14px; color: #555 }}
figure {{ margin: 2rem 0 }} li {{ margin: .3rem 0 }}
"""


def grade(landmark: LandmarkCheck) -> str:
    """Return 'faulty', 'minor' or 'sound'."""
    if landmark.severity >= SERIOUS:
        return 'faulty'
    return 'minor' if landmark.faults else 'sound'


def write_report(folder: Path, name: str, report: CheckReport,
                 pictures: Iterable[tuple[str, str, bytes]]) -> None:
    """Write the page and the JSON file of a check of a named map, each in one step.

    Pictures have a name, a caption and a PNG each. OptionsError: a file cannot be written; the old
    one stays.
    """
    data = _finite({'map': name, **report.as_dict()})
    write_text(folder / DATA, json.dumps(data, indent=1, allow_nan=False))
    write_text(folder / PAGE, _page(name, report, pictures))


def _finite(value: Any) -> Any:
    """Return a tree with null for numbers that JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _page(name: str, report: CheckReport, pictures: Iterable[tuple[str, str, bytes]]) -> str:
    title = escape(f'Check of {name}')
    verdict = '<p class="verdict passed"><b>The map reaches all thresholds.</b></p>' \
        if report.passed else ('<div class="verdict failed"><b>The map misses these thresholds:'
                               f'</b>{_list(report.failures)}</div>')
    parts = ['<!DOCTYPE html>', '<html lang="en">', '<meta charset="utf-8">',
             '<meta name="viewport" content="width=device-width">',
             f'<title>{title}</title>', f'<style>{_STYLE}</style>', f'<h1>{title}</h1>', verdict,
             '<h2>What to do</h2>', _list(report.advice), '<h2>Figures</h2>',
             _table(('', ''), _figures(report))]
    for picture, caption, png in pictures:
        data = b64encode(png).decode('ascii')
        parts.append(f'<figure><img alt="{escape(picture)}" src="data:image/png;base64,{data}">'
                     f'<figcaption>{escape(caption)}</figcaption></figure>')
    parts += ['<h2>Landmarks, worst first</h2>', _landmarks(report.landmarks)]
    if report.look_alikes:
        parts += ['<h2>Places that look alike</h2>', _look_alikes(report)]
    if report.recording is not None:
        rows = [(str(number), str(one.frames), str(one.landmarks), str(one.boxes.boxes),
                 f'{one.boxes.explained:.1%}', f'{one.boxes.median_iou:.3f}')
                for number, one in enumerate(report.recording.folds, start=1)]
        parts += ['<h2>Held-out boxes</h2>',
                  '<p>Blocks of time take turns in being judged; landmarks are fitted to the '
                  'other blocks.</p>',
                  _table(('#fold', '#frames', '#landmarks', '#boxes', '#explained',
                          '#median IoU'), rows),
                  '<h2>Systematic residuals</h2>', _corrections(report.recording)]
    return '\n'.join([*parts, '<h2>What these figures rest on</h2>', _list(report.notes),
                      '</html>', ''])


def summary_lines(report: CheckReport) -> list[str]:
    """Return the figures as lines of text, for a terminal."""
    return [f'{name}: {value}' for name, value in _figures(report)]


def _figures(report: CheckReport) -> list[tuple[str, str]]:
    faulty = sum(grade(one) == 'faulty' for one in report.landmarks)
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
            ('recorded frames, cross-validated', _verdicts(one.judged) + (
                '' if len(one.judged) == len(one.trials) else
                f'; of all {_verdicts(one.trials)}: no other part of the recording shows the '
                'objects of the rest')),
            *([('of these by objects alone', str(count_by_objects(one.judged)['accepted']))]
              if any(trial.by_objects for trial in one.trials) else []),
            ('the same poses with simulated boxes', _verdicts(one.simulated)),
            ('noise of box edges', f'{one.edge_scale:.2f} times that assumed by build_map')]
    if report.queries:
        rows.append(('queries with recorded similarities', _verdicts(report.queries)))
    rows += [('grid views', _verdicts(report.grid.trials)),
             ('grid positions near the recording with an accepted heading'
              if report.recording else 'grid positions with an accepted heading',
              f'{report.grid.accepted_positions:.0%} of {int(report.grid.is_near.sum())}')]
    if report.accepted_positions != report.grid.accepted_positions:
        rows.append(('these positions, with keyframes', f'{report.accepted_positions:.0%}'))
    if (layer := report.keyframes) is not None:
        rows.append(('keyframes', f'{layer.keyframes} with {layer.points} points'))
        if len(layer.recorded):
            rows.append(('recorded frames within reach of a keyframe',
                         f'{layer.recorded.mean():.0%} of {len(layer.recorded)}'))
        rows.append(('grid positions within reach of a keyframe',
                     f'{layer.reached_positions:.0%} of {int(layer.is_near.sum())}'))
    return rows


def _verdicts(trials: Sequence[Trial]) -> str:
    counts = count_verdicts(trials)
    accepted = share(trials, 'accepted')
    return (f'{counts["accepted"]} of {len(trials)} accepted ({accepted:.0%}), '
            f'{counts["refused"]} refused, {counts["misled"]} misled')


def _landmarks(landmarks: Sequence[LandmarkCheck]) -> str:
    head = ('landmark', 'label', 'faults', '#frames', '#seen [%]', '#baseline [°]',
            '#deviation [cm]', '#offset [cm]', '#IoU', '#thinness', 'overlaps with')
    rows = []
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
        rows.append('<tr>' + ''.join([
            _cell(one.landmark_id, grade(one)), _cell(label, 'text'), _cell(faults, 'text'),
            *(_cell(text, 'number') for text in texts),
            _cell(', '.join(f'{name} ({distance:.2f})' for name, distance in one.overlaps))])
            + '</tr>')
    rest = len(landmarks) - _MOST_LANDMARKS
    more = f'<p class="note">and {rest} more in the JSON file</p>' if rest > 0 else ''
    return (f'<div class="scroll"><table>{_head(head)}{"".join(rows)}</table></div>{more}'
            '<p class="note">frames: with the landmark, of those that should show it. seen: '
            'their share. baseline: greatest angle between two views. deviation: of the centre '
            'on its worst axis. offset: from the centre to where its boxes put it. IoU: median '
            'of its boxes. thinness: least by greatest semi-axis. In brackets: the normalized '
            'distance of an overlap.</p>')


def _look_alikes(report: CheckReport) -> str:
    rows = []
    for number, one in enumerate(report.look_alikes, start=1):
        pairs = ', '.join(f'{first} = {second}' for first, second in one.matched[:_MOST_MATCHED])
        if len(one.matched) > _MOST_MATCHED:
            pairs += f' and {len(one.matched) - _MOST_MATCHED} more'
        rows.append((str(number), f'{one.first[0]:.1f}, {one.first[1]:.1f}',
                     f'{one.second[0]:.1f}, {one.second[1]:.1f}', f'{one.turn_deg:.0f}',
                     f'{len(one.matched)} of {one.landmarks}', str(one.same_labels), pairs))
    return _table(('#pair', 'a: x, y [m]', 'b: x, y [m]', '#turn [deg]', '#landmarks alike',
                   '#with equal labels', 'which'), rows)


def _corrections(recording: RecordingCheck) -> str:
    if not recording.corrections:
        return '<p>Too few boxes to tell.</p>'
    rows = [(one.cause, one.name, f'{one.value:+.2f} {one.unit}',
             f'{one.deviation:.2f} {one.unit}', f'{one.effect_px:.1f}',
             f'{one.explained:.1%}', '' if not one.is_significant else (
                 'may follow from the cause that explains most' if one.follows
                 else 'significant'))
            for one in recording.corrections]
    return ('<p>The correction that fits the edges of the boxes best, each cause on its own. A '
            'turned mount and a shifted principal point look much the same.</p>'
            + _table(('cause', 'what', '#correction', '#deviation', '#effect [px]',
                       '#cost that the cause explains', ''), rows))


def _list(texts: Iterable[str]) -> str:
    return '<ul>' + ''.join(f'<li>{escape(text)}</li>' for text in texts) + '</ul>'


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; a heading that begins with # aligns its column to the right."""
    body = ''.join('<tr>' + ''.join(
        _cell(text, 'number' if title.startswith('#') else '')
        for title, text in zip(head, row, strict=True)) + '</tr>' for row in rows)
    return f'<div class="scroll"><table>{_head(head) if any(head) else ""}{body}</table></div>'


def _head(titles: Sequence[str]) -> str:
    return '<tr>' + ''.join(
        f'<th{" class=number" if title.startswith("#") else ""}>{escape(title.lstrip("#"))}</th>'
        for title in titles) + '</tr>'


def _cell(text: str, kind: str = '') -> str:
    return f'<td{f" class={kind}" if kind else ""}>{escape(text)}</td>'
