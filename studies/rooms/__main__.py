# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Real rooms: ``python -m studies.rooms FOLDER... --model yolov8n.pt``.

Each room is mapped by a part of its images, and asked with the rest: split by time (images in
turn, and halves), by where the camera looks, and by its height, the latter also with another
camera (a part of the image, coarser); by objects, keyframes and both, and, with depth, by SIFT
with PnP. Its maps are asked with images of all other rooms, too, where
each accepted pose is false; a folder of ``images`` without poses serves for that alone. Objects
are matched by classes. The vertical is that of accelerometer.txt where a folder has one, else the
true one with an error of 1 degree.

Writes rooms.html with tables and pictures, and outcomes.json.
"""

import argparse
import json
import sys
from dataclasses import asdict
from functools import partial
from pathlib import Path

from tqdm import tqdm

from cliploc_ros.command import not_negative, positive_int, run_command
from cliploc_ros.errors import OptionsError
from cliploc_ros.files.parallel import run_tasks
from cliploc_ros.files.storage import make_folder, write_text
from studies.rooms.asking import KNOWN, Answers, make_ask, tasks_of
from studies.rooms.page import write_page
from studies.rooms.rooms import ROBOT, RoomOptions, read_room
from studies.rooms.tables import tables

_KINDS = 'in turn', 'halves', 'directions', 'heights', ROBOT


def run() -> int:
    """Ask all rooms; return the exit code."""
    parser = argparse.ArgumentParser(prog='python -m studies.rooms', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('folders', nargs='+', metavar='DIR[@METRES]',
                        help='with the unit of depth, where it is not that of the layout')
    parser.add_argument('--model', required=True, help='weights of YOLO')
    parser.add_argument('--conf', type=not_negative, default=RoomOptions.conf,
                        help='least confidence of a box (%(default)s)')
    parser.add_argument('--kinds', nargs='+', choices=_KINDS, default=_KINDS, metavar='KIND',
                        help=f'of splits: {", ".join(_KINDS)} (all)')
    parser.add_argument('--images', type=positive_int, default=10_000, metavar='N',
                        help='the most images that a part is asked (all)')
    parser.add_argument('--known', nargs='+', choices=KNOWN, default=KNOWN, metavar='WHAT',
                        help=f'besides the image: {", ".join(KNOWN)} (all)')
    parser.add_argument('--elsewhere', type=int, default=20, metavar='N',
                        help="images of each other room that a part's map is asked (%(default)s)")
    parser.add_argument('--baseline', action='store_true', help='SIFT with PnP, too')
    parser.add_argument('--out', type=Path, default=Path('rooms'), metavar='DIR',
                        help='also keeps what networks say of the images (%(default)s)')
    parser.add_argument('--workers', type=positive_int, default=1, metavar='N')
    options = parser.parse_args()
    if options.elsewhere < 0:
        raise OptionsError('--elsewhere must not be below 0')
    names = [Path(one.partition('@')[0]).name for one in options.folders]
    if len(set(names)) < len(names):
        raise OptionsError('two folders have one name: rename one')
    make_folder(options.out)
    reading = RoomOptions(options.model, options.out, options.conf)
    rooms = [read_room(one, reading) for one in options.folders]
    if ROBOT in options.kinds:  # recorded once, before several workers need it
        for room in rooms:
            if room.has_poses:
                room.by_robot  # noqa: B018
    tasks = [task for room in rooms
             for task in tasks_of(room, options.kinds, options.images, options.elsewhere,
                                  options.known)]
    found: list[Answers] = [answers for _, answers in tqdm(run_tasks(
        partial(make_ask, options.folders, reading, options.baseline), tasks,
        workers=options.workers), 'parts', len(tasks), disable=None) if answers is not None]
    found.sort(key=lambda one: tasks.index(one.task))
    text = tables(found, rooms)
    print(text)
    write_text(options.out / 'outcomes.json', json.dumps(
        [asdict(outcome) for one in found for outcome in one.outcomes], indent=0))
    write_page(options.out / 'rooms.html', found, rooms, text)
    print(f'wrote {options.out / "rooms.html"}')
    return 0


if __name__ == '__main__':
    sys.exit(run_command(run))
