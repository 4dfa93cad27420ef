# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Two recordings of a room: ``python -m studies.rooms.recordings FOLDER... --model yolov8n.pt``.

The halves of each room by viewing direction are two recordings. The second one is dark and
blurred. Every sixth image of both is left out of the maps, and is a query; those of the second
half are also queries as they are recorded, dark and blurred. The maps:

first, second   of one recording
joined          of both, as by ``build_map`` with two recordings
updated         the first map, updated with the second recording
stale updated   the same, but in the first map everything on one side of an upright plane is 1 m
                from its place

Images of the other rooms, and of folders of ``images`` without poses, are queries, too: each
accepted pose of these is false.
"""

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from cliploc_ros.command import positive_int, run_command
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.keyframes.localization import KeyframeLocalizer
from cliploc_ros.offline.datasets.map_recording import MapRecording
from cliploc_ros.offline.mapping.make_map import (
    Labeller,
    MadeMap,
    make_map,
    update_map,
    write_made_map,
)
from cliploc_ros.offline.mapping.options import MappingOptions
from cliploc_ros.offline.mapping.posed_detections import join_detections
from cliploc_ros.offline.recording.joining import add_layer
from cliploc_ros.offline.recording.keyframe_layer import LayerOptions
from studies.keyframes.cases import World, moved_half
from studies.reports import answer_table, print_section, run_all
from studies.rooms.asking import BOTH, NOTHING, WAYS, Outcome, Task, outcome_of
from studies.rooms.rooms import Image, Room, RoomOptions, Rows, read_room

_KIND, _EACH, _PER_CELL = 'directions', 6, 40
MAPS = 'first', 'second', 'joined', 'updated', 'stale updated'
_LIGHT, _BLUR_PX, _STALE_M, _LATER_S = 0.3, 1.5, 1.0, 1e4


def _dark(image_rgb: Image, camera: Camera) -> tuple[Image, Camera]:
    """Return a dark and blurred image."""
    image = (image_rgb * _LIGHT).astype(np.uint8)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), _BLUR_PX), dtype=np.uint8), camera


def make_maps(room: Room, dim: Room, first: Rows, second: Rows) -> Iterator[tuple[str, MadeMap]]:
    """Yield maps of two recordings by name."""
    def one(seen: Room, rows: Rows) -> MadeMap:
        return make_map(seen.detections.select_frames(rows), Labeller({}),
                        frames=seen.frames.select(rows.tolist()), layer=LayerOptions())

    begin, end = one(room, first), one(dim, second)
    yield MAPS[0], begin
    yield MAPS[1], end
    assert begin.layer is not None and end.layer is not None
    layer, placing, note = add_layer(begin.layer, end.layer, False, False, _PER_CELL)
    print(f'{room.name}: {note}', flush=True)
    detections = dim.detections.select_frames(second).moved(*placing)
    yield MAPS[2], make_map(join_detections([
        room.detections.select_frames(first), replace(
            detections, stamps_s=detections.stamps_s + _LATER_S, stamps_ns=None)]),
        Labeller({}), layer=layer)
    yield MAPS[3], _updated(begin, dim, second)
    world = moved_half(_STALE_M, World(begin.landmark_map, begin.layer, np.zeros(3)),
                       np.random.default_rng(0))
    yield MAPS[4], _updated(replace(
        begin, landmark_map=world.landmark_map, layer=world.layer), dim, second)


def _updated(old: MadeMap, seen: Room, rows: Rows) -> MadeMap:
    with TemporaryDirectory() as folder:
        path = Path(folder) / 'map.yaml'
        write_made_map(path, old, (), MapRecording(Path(folder)))
        made = update_map(path, seen.detections.select_frames(rows), Labeller({}),
                          MappingOptions(), seen.frames.select(rows.tolist()), LayerOptions())
    print(f'{seen.name}: {"; ".join(made.report.lines()[:1])}; '
          f'{made.keyframes and made.keyframes.line()}', flush=True)
    return made


def make_ask(folders: Sequence[str], reading: RoomOptions, elsewhere: int
             ) -> Callable[[str], list[Outcome]]:
    """Return the function that maps a room in all ways, and localizes queries, for a worker."""
    cv2.setNumThreads(1)

    @lru_cache
    def rooms() -> dict[str, Room]:
        return {room.name: room for room in (read_room(folder, reading) for folder in folders)}

    def ask(name: str) -> list[Outcome]:
        room, found = rooms()[name], list[Outcome]()
        dim = room.changed(_dark, 'dark', keeps_depth=True)
        mapped = next(mapped for kind, _, mapped, _ in room.parts() if kind == _KIND)
        rows = np.arange(len(room))
        is_asked = rows % _EACH == _EACH // 2
        is_first = np.isin(rows, mapped)
        first, second = rows[is_first & ~is_asked], rows[~is_first & ~is_asked]
        asked = {'first': (room, rows[is_first & is_asked]),
                 'second': (room, rows[~is_first & is_asked]),
                 'second, dark': (dim, rows[~is_first & is_asked])}
        others = [other for other in rooms().values() if other.name != name]
        for which, made in make_maps(room, dim, first, second):
            keyframes = None if made.layer is None else KeyframeLocalizer(made.layer)
            own = partial(outcome_of, known=NOTHING, landmark_map=made.landmark_map,
                          keyframes=keyframes)
            for part, (seen, some) in asked.items():
                found += [own(Task(name, which, part), seen, seen.queries[row], way)
                          for row, way in product(some, WAYS[:3])]
            rng = np.random.default_rng(MAPS.index(which))
            for other in others if which in MAPS[2:] else ():
                found += [own(Task(name, which, 'other rooms'), other, other.queries[row], BOTH)
                          for row in rng.permutation(len(other))[:elsewhere]]
        return found
    return ask


def run() -> int:
    """Map and query all rooms; return the exit code."""
    parser = argparse.ArgumentParser(
        prog='python -m studies.rooms.recordings', description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('folders', nargs='+', metavar='DIR[@METRES]',
                        help='folders of rooms, with the unit of depth if the layout has none')
    parser.add_argument('--model', required=True, help='weights of YOLO')
    parser.add_argument('--only', nargs='+', metavar='ROOM', help='only maps of these rooms')
    parser.add_argument('--elsewhere', type=int, default=20, metavar='N',
                        help='queries of a map from each other room (%(default)s)')
    parser.add_argument('--out', type=Path, default=Path('rooms'), metavar='DIR',
                        help='folder for the output of networks (%(default)s)')
    parser.add_argument('--workers', type=positive_int, default=1, metavar='N')
    options = parser.parse_args()
    reading = RoomOptions(options.model, options.out, scales={})
    rooms = [read_room(folder, reading) for folder in options.folders]
    names = [room.name for room in rooms if room.has_poses]
    found: list[Outcome] = run_all(partial(make_ask, options.folders, reading, options.elsewhere),
                                   options.only or names, 'rooms', options.workers)
    here = [outcome for outcome in found if outcome.is_here]
    for by in (['kind', 'way'], ['room', 'kind', 'way'], ['kind', 'part', 'way']):
        print_section(f'Success by {", ".join(by)}', answer_table(here, by))
    print_section('Images of other rooms: all accepted are false', answer_table(
        [outcome for outcome in found if not outcome.is_here], ['room', 'kind', 'way']))
    return 0


if __name__ == '__main__':
    sys.exit(run_command(run))
