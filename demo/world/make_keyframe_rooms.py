# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Make rooms to judge keyframes in: ``python -m demo.world.make_keyframe_rooms DIR SEED ...``.

Each room DIR/room_SEED has the exact map and folders of images. Two folders are for making layers:
``mapping``, the demo's mapping walk, and ``one_side``, a walk around the room that looks ahead.
The others are queries. ``viewpoints`` shows the demo's wake-ups in the room as it was mapped,
``other_light`` shows them in another light after four objects moved, and ``other_side`` is a walk
around the room in the opposite direction. ``viewpoints_aside`` and ``other_light_aside`` are
second looks from 20 cm to the side.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.transforms import make_transform
from demo.world.appearance import CLASSES
from demo.world.make_changed_room import round_walk
from demo.world.recording import record, write_true_map
from demo.world.renderer import FIRST_LIGHT, LATER_LIGHT, Renderer
from demo.world.room import make_room, move_objects
from demo.world.trajectories import CAMERA, mapping_walk, query_walk

_MAPPING_IMAGES, _SIDE_IMAGES = 30, 24
# 20 cm to the right, turned by 5 degrees to the left.
_ASIDE = make_transform(Rotation.from_euler('y', -5.0, degrees=True).as_matrix(),
                        np.array([0.2, 0.0, 0.0]))


def make_keyframe_room(folder: Path, seed: int, queries: int) -> None:
    """Write the map and the walks of a room."""
    room = make_room(seed, dict.fromkeys(CLASSES, 8))
    later = move_objects(room, 4, seed + 1)
    renderer = Renderer(room, CAMERA, FIRST_LIGHT)
    changed = Renderer(later, CAMERA, LATER_LIGHT)
    sides = round_walk(2 * _SIDE_IMAGES, 0.0, 1.45)
    walks = {'mapping': mapping_walk(_MAPPING_IMAGES), 'one_side': sides[:_SIDE_IMAGES],
             'other_side': sides[_SIDE_IMAGES:][:: max(1, _SIDE_IMAGES // queries)],
             'viewpoints': query_walk(queries), 'other_light': query_walk(queries)}
    walks |= {f'{name}_aside': walks[name] @ _ASIDE for name in ('viewpoints', 'other_light')}
    folder.mkdir(parents=True, exist_ok=True)
    write_true_map(folder / 'map.yaml', room)
    for number, (name, poses) in enumerate(walks.items()):
        shown = (later, changed) if name.startswith('other_light') else (room, renderer)
        record(folder / name, *shown, poses, seed=seed + 5 + number, rate_hz=2.0)


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog='make_keyframe_rooms', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('folder', type=Path, metavar='DIR')
    parser.add_argument('seeds', type=int, nargs='+', metavar='SEED')
    parser.add_argument('--queries', type=int, default=24,
                        help='images of each walk of queries (%(default)s)')
    options = parser.parse_args()
    for seed in options.seeds:
        make_keyframe_room(options.folder / f'room_{seed}', seed, options.queries)


if __name__ == '__main__':
    main()
