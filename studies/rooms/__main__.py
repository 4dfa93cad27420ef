# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Real rooms: ``python -m studies.rooms FOLDER... --model yolov8n.pt``.

A part of each room's images is mapped, and the other part is localized. The images are split by
time (alternately, and into halves), by the viewing direction, and by the height of the camera; the
last split is repeated with another camera (a coarser part of the image). Poses come from objects,
from keyframes, from both and, with --baseline, from RootSIFT, tracks and pycolmap. Images of all
other rooms are queries as well; there each accepted pose is false. A folder of ``images`` without
poses serves only as such a room. Objects are matched by class. The vertical comes from
accelerometer.txt if the folder has it, otherwise from the true pose with an error of 1 degree.

The program prints tables, and writes outcomes.json.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from functools import partial
from itertools import pairwise
from math import inf
from pathlib import Path

import numpy as np

from cliploc_ros.cli.sources import metres_of
from cliploc_ros.command import not_negative, positive_int, run_command
from cliploc_ros.errors import OptionsError
from cliploc_ros.files.storage import make_folder, write_text
from studies.blame import CAUSES
from studies.reports import (
    SUCCESS_M,
    answer_table,
    crossed_table,
    grouped,
    print_section,
    run_all,
    short,
    success_cell,
    table,
)
from studies.rooms import asking
from studies.rooms.rooms import ROBOT, Room, RoomOptions, read_room

_KINDS = 'in turn', 'halves', 'directions', 'heights', ROBOT
# Bounds of the bins of confidence.
_BINS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, inf)


def run() -> int:
    """Map and query all rooms; return the exit code."""
    parser = argparse.ArgumentParser(prog='python -m studies.rooms', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('folders', nargs='+', metavar='DIR[@METRES]',
                        help='folders of rooms, with the unit of depth if the layout has none')
    parser.add_argument('--scale', nargs=2, action='append', default=[], metavar=('DIR', 'METRES'),
                        help='unit of the poses of a folder that does not state it [m]')
    parser.add_argument('--model', required=True, help='weights of YOLO')
    parser.add_argument('--conf', type=not_negative, default=RoomOptions.conf,
                        help='least confidence of a box (%(default)s)')
    parser.add_argument('--kinds', nargs='+', choices=_KINDS, default=_KINDS, metavar='KIND',
                        help=f'kinds of splits: {", ".join(_KINDS)} (all)')
    parser.add_argument('--images', type=positive_int, default=10_000, metavar='N',
                        help='greatest number of queries of a part (all)')
    parser.add_argument('--known', nargs='+', choices=asking.KNOWN, default=asking.KNOWN,
                        metavar='WHAT',
                        help=f'input besides the image: {", ".join(asking.KNOWN)} (all)')
    parser.add_argument('--elsewhere', type=int, default=20, metavar='N',
                        help='queries of a map from each other room (%(default)s)')
    parser.add_argument('--baseline', action='store_true',
                        help='also localize with RootSIFT, tracks and pycolmap')
    parser.add_argument('--out', type=Path, default=Path('rooms'), metavar='DIR',
                        help='folder for results and for the output of networks (%(default)s)')
    parser.add_argument('--workers', type=positive_int, default=1, metavar='N')
    options = parser.parse_args()
    if options.elsewhere < 0:
        raise OptionsError('--elsewhere must not be negative')
    names = [Path(folder.partition('@')[0]).name for folder in options.folders]
    if len(set(names)) < len(names):
        raise OptionsError('two folders have the same name: rename one of them')
    make_folder(options.out)
    scales = {Path(name).name: metres_of(text, '--scale') for name, text in options.scale}
    if unknown := sorted(set(scales) - set(names)):
        raise OptionsError(f'--scale {unknown[0]}: expected the name of one of the folders')
    reading = RoomOptions(options.model, options.out, options.conf, scales)
    rooms = [read_room(folder, reading) for folder in options.folders]
    if ROBOT in options.kinds:  # recorded once, before several workers need it
        for room in rooms:
            if room.has_poses:
                room.by_robot  # noqa: B018
    asked = asking.AskOptions(options.images, options.elsewhere, options.known, options.baseline)
    found: list[asking.Answers] = run_all(
        partial(asking.make_ask, options.folders, reading, asked),
        [asking.Task(room.name, kind, part) for room in rooms for kind, part, *_ in room.parts()
         if kind in options.kinds], 'parts', options.workers)
    for heading, text in _tables(found, rooms):
        print_section(heading, text)
    write_text(options.out / 'outcomes.json', json.dumps(
        [asdict(outcome) for answer in found for outcome in answer.outcomes], indent=0))
    return 0


def _tables(answers: Sequence[asking.Answers], rooms: Sequence[Room]) -> Iterator[tuple[str, str]]:
    """Yield all tables with their headings; rows keep the order of rooms, ways and input."""
    failures = [(answer.task.room, answer.task.part, answer.failure)
                for answer in answers if answer.failure]
    if failures:
        yield 'Not mapped', table(['room', 'part', 'why'], failures)
    names = [room.name for room in rooms]
    outcomes = sorted(
        (outcome for answer in answers for outcome in answer.outcomes),
        key=lambda outcome: (names.index(outcome.room), asking.WAYS.index(outcome.way),
                             asking.KNOWN.index(outcome.known)))
    here = [outcome for outcome in outcomes if outcome.is_here]
    objects = [outcome for outcome in here if outcome.way == asking.OBJECTS]
    yield 'Rooms', _room_table(answers, rooms)
    yield 'At a glance', crossed_table(here, 'way', 'room', _glance)
    yield 'By distance', crossed_table(here, 'way', 'room', _by_distance)
    yield 'Success and acceptance', answer_table(here, ['room', 'kind', 'way', 'known'])
    yield 'All splits of a room', answer_table(here, ['room', 'way', 'known'])
    posed = [outcome for outcome in here
             if outcome.error_m < inf and outcome.way != asking.BASELINE]
    for by in (['source'], ['source', 'room']):
        yield f'Poses by {" and ".join(by)}; of each confidence those that are right', \
            answer_table(posed, by, **{f'from_{low:g}_on': _share_right(low, high)
                                       for low, high in pairwise(_BINS)})
    elsewhere = [outcome for outcome in outcomes if not outcome.is_here]
    yield 'Images of other rooms: all accepted are false', '\n\n'.join(
        answer_table(elsewhere, by) for by in (['room', 'way'], ['way']))
    yield 'Other rooms at a glance', table(['way', 'images of other rooms', 'accepted'], [
        (way, len(own), sum(outcome.accepted for outcome in own))
        for (way,), own in grouped(elsewhere, ['way']).items()])
    yield 'Why objects fail by more than .5 m', answer_table(
        [outcome for outcome in objects if outcome.known == asking.NOTHING], ['room', 'kind'],
        **{cause: _count(cause) for cause in CAUSES})
    yield 'Boxes that an image needs', answer_table(
        sorted(objects, key=lambda outcome: outcome.boxes_from), ['room', 'known', 'boxes_from'])


def _glance(outcomes: Sequence[asking.Outcome]) -> str:
    text = success_cell(outcomes)
    # the baseline has no acceptance
    return text.partition(';')[0] if outcomes[0].way == asking.BASELINE else text


def _by_distance(outcomes: Sequence[asking.Outcome]) -> str:
    return ' '.join(short(float(np.mean([outcome.error_m < limit for outcome in outcomes])))
                    for limit in SUCCESS_M)


def _share_right(low: float, high: float) -> Callable[[Sequence[asking.Outcome]], str]:
    """Return a column with the share of correct poses within a range of confidence."""
    def share(outcomes: Sequence[asking.Outcome]) -> str:
        own = [outcome.right for outcome in outcomes if low <= outcome.confidence < high]
        return f'{np.mean(own):.2f} of {len(own)}' if own else ''

    return share


def _count(cause: str) -> Callable[[Sequence[asking.Outcome]], int]:
    return lambda outcomes: sum(outcome.cause == cause for outcome in outcomes)


def _room_table(answers: Sequence[asking.Answers], rooms: Sequence[Room]) -> str:
    rows = []
    for room in rooms:
        maps = [answer for answer in answers if answer.task.room == room.name
                and not answer.failure]
        boxes = np.diff(room.detections.frame_offsets)
        size = np.ptp(room.detections.map_from_camera[:, :3, 3], axis=0)
        rows.append((room.name, len(room), f'{boxes.mean():.1f}', f'{np.mean(boxes >= 3):.2f}',
                     ' x '.join(f'{side:.1f}' for side in size), *(
                         f'{min(counts)} to {max(counts)}' if counts else '' for counts in (
                             [answer.landmarks for answer in maps],
                             [answer.keyframes for answer in maps]))))
    return table(['room', 'images', 'boxes an image', 'with three or more', 'path [m]',
                  'landmarks of a part', 'keyframes of a part'], rows)


if __name__ == '__main__':
    sys.exit(run_command(run))
