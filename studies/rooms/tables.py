# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The tables of all rooms: Markdown."""

from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import pairwise
from math import inf

import numpy as np

from cliploc_ros.core.geometry.transforms import RIGHT_M
from cliploc_ros.offline.evaluation.figures import within_ellipsoid
from studies import reports
from studies.reports import BINS, FAR_DEG, FAR_M, SUCCESS_M, interval, table
from studies.rooms.asking import (
    BOTH,
    KEYFRAMES,
    KNOWN,
    NOTHING,
    OBJECTS,
    SIFT,
    WAYS,
    Answers,
    Outcome,
)
from studies.rooms.rooms import Room

# Numbers of boxes in an image, from and to.
_BOXES = (0, 2), (3, 3), (4, 4), (5, 6), (7, 50)
_MOST_CLASSES = 15


def tables(answers: Sequence[Answers], rooms: Sequence[Room]) -> str:
    """Return all tables, each under a heading."""
    outcomes = [one for answer in answers for one in answer.outcomes]
    here = [one for one in outcomes if one.is_here]
    columns = ['room', 'split', 'by', 'known', 'images', *(f'{limit:g} m' for limit in SUCCESS_M),
               'accepted', 'false', f'{FAR_M:g} m or {FAR_DEG:g} deg off', 'recall', 'in 95 %']
    rows = [(*key, *success(its)) for key, its in grouped(here, 'room', 'kind', 'way', 'known')]
    failures = [f'{one.task.room}, {one.task.part}: not mapped: {one.failure}'
                for one in answers if one.failure]
    return '\n\n'.join([*failures,
        '## Rooms', _room_table(answers, rooms),
        '## Success and acceptance', table(columns, rows),
        '## All splits of a room', table(
            [one for one in columns if one != 'split'],
            [(*key, *success(its)) for key, its in grouped(here, 'room', 'way', 'known')]),
        '## Accepted poses and confidence by source', _source_table(here),
        '## Images of other rooms', table(
            ['map of', 'by', 'images', 'accepted (all false)', '95 % of images'],
            [(*('all rooms', *key)[-2:], *_false(its))
             for by in (('room', 'way'), ('way',)) for key, its in grouped(
                 [one for one in outcomes if not one.is_here], *by)]),
        '## Why objects fail by more than .5 m', _blame_table(here),
        '## Boxes that an image needs', _boxes_table(here),
        '## Classes that carry accepted poses of objects', _class_table(here, rooms)])


def grouped(outcomes: Iterable[Outcome], *by: str
            ) -> list[tuple[tuple[str, ...], list[Outcome]]]:
    """Return outcomes in groups of equal fields: ways and what is known in their own order."""
    order, groups = [*WAYS, *KNOWN], reports.grouped(outcomes, by)
    # other names in the order in which they come first
    order += [name for key in groups for name in key if name not in order]
    return sorted(groups.items(), key=lambda pair: [order.index(name) for name in pair[0]])


def success(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the cells about images of the mapped room."""
    errors = np.array([one.error_m for one in outcomes])
    accepted = np.array([one.accepted for one in outcomes])
    right = errors < RIGHT_M
    nees = np.array([one.nees for one in outcomes])[accepted & right]
    cells = [str(len(outcomes)), *(f'{np.mean(errors < limit):.2f}' for limit in SUCCESS_M)]
    if outcomes[0].way not in (OBJECTS, KEYFRAMES, BOTH):
        return [*cells, '', '', '', '', '']
    far = (errors > FAR_M) | (np.array([one.error_deg for one in outcomes]) > FAR_DEG)
    return [*cells, str(accepted.sum()), str((accepted & ~right).sum()),
            str((accepted & far).sum()),
            f'{accepted[right].mean():.2f}' if right.any() else '',
            f'{within_ellipsoid(nees):.2f}' if len(nees) else '']


def _source_table(here: Sequence[Outcome]) -> str:
    """Return a row for each source: what was accepted, and the share right by confidence."""
    rows = []
    for by in (('source',), ('source', 'room')):
        for key, its in grouped([one for one in here if one.error_m < inf and one.way != SIFT],
                                *by):
            accepted = [one for one in its if one.accepted]
            false = sum(one.error_m >= RIGHT_M for one in accepted)
            inside = within_ellipsoid(np.array([one.nees for one in accepted])) if accepted else 0
            cells = []
            for low, high in pairwise(BINS):
                own = [one.error_m < RIGHT_M for one in its
                       if low <= one.confidence < high or one.confidence == high == 1.0]
                cells.append(f'{np.mean(own):.2f} of {len(own)}' if own else '')
            rows.append([*key, *['all rooms'][:2 - len(key)], len(accepted), false,
                         interval(false, len(accepted)), f'{inside:.2f}' if accepted else '',
                         *cells])
    return table(['source', 'room', 'accepted', 'false', '95 %', 'in 95 %', *(
        f'confidence {low:g} to {high:g}: right' for low, high in pairwise(BINS))], rows)


def _false(outcomes: Sequence[Outcome]) -> list[str]:
    false = sum(one.accepted for one in outcomes)
    return [str(len(outcomes)), str(false), interval(false, len(outcomes), 4)]


def _room_table(answers: Sequence[Answers], rooms: Sequence[Room]) -> str:
    rows = []
    for room in rooms:
        maps = [one for one in answers if one.task.room == room.name and one.landmark_map]
        boxes = np.diff(room.detections.frame_offsets)
        size = np.ptp(room.detections.map_from_camera[:, :3, 3], axis=0)
        rows.append((room.name, len(room), f'{boxes.mean():.1f}', f'{np.mean(boxes >= 3):.2f}',
                     *([''] * 3 if not maps else (
                         ' x '.join(f'{one:.1f}' for one in size),
                         _range([len(one.landmark_map) for one in maps if one.landmark_map]),
                         _range([one.keyframes for one in maps])))))
    return table(['room', 'images', 'boxes an image', 'with three or more', 'path [m]',
                  'landmarks of a part', 'keyframes of a part'], rows)


def _range(values: Sequence[int]) -> str:
    return f'{min(values)} to {max(values)}'


def _blame_table(here: Sequence[Outcome]) -> str:
    asked = [one for one in here if one.way == OBJECTS and one.known == NOTHING]
    causes = ['objects', 'map', 'candidates', 'search', 'choice']
    rows = []
    for key, its in grouped(asked, 'room', 'kind'):
        counts = Counter(one.cause for one in its)
        rows.append((*key, len(its), counts[''], *(counts[cause] for cause in causes)))
    return table(['room', 'split', 'images', 'right', *causes], rows)


def _boxes_table(here: Sequence[Outcome]) -> str:
    rows = []
    for key, its in grouped([one for one in here if one.way == OBJECTS], 'room', 'known'):
        for low, high in _BOXES:
            some = [one for one in its if low <= one.boxes <= high]
            if some:
                cells = success(some)
                rows.append((*key, f'{low} to {high}' if high > low else low, cells[0],
                             *cells[3:7]))
    return table(['room', 'known', 'boxes', 'images', '0.5 m', '1 m', 'accepted', 'false'], rows)


def _class_table(here: Sequence[Outcome], rooms: Sequence[Room]) -> str:
    rows = []
    for room in rooms:
        names = [room.detections.class_names[one] for one in room.detections.classes]
        boxes, its = Counter(names), [one for one in here if one.room == room.name
                                      and one.way == OBJECTS and one.accepted]
        carried = Counter(name for one in its for name in one.classes)
        if its:
            rows += [(room.name, name, f'{count / len(room):.2f}',
                      f'{carried[name] / len(its):.2f}')
                     for name, count in boxes.most_common(_MOST_CLASSES)]
    return table(['room', 'class', 'boxes an image', 'objects an accepted pose'], rows)
