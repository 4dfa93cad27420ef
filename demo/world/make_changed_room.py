# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Make a room before and after changes: ``python -m demo.world.make_changed_room DIR``.

The room is the demo's, without the objects that its map lacks. The program writes two walks,
before/ and after/, the exact maps of both, and the changes, changes.json: four objects swap their
places in pairs, two are removed, three are added, and the light changes. With ``--free-places``
the four objects move to empty places instead.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from demo.world.appearance import CLASSES
from demo.world.make_demo_world import SEED
from demo.world.recording import record, write_true_map
from demo.world.renderer import FIRST_LIGHT, LATER_LIGHT, Renderer
from demo.world.room import Room, find_places, make_room, move_objects
from demo.world.trajectories import CAMERA, walk

_COUNTS = dict.fromkeys(CLASSES, 8)
_MOVED, _REMOVED, _NEW = 4, 2, 3
# Greatest distance of an object from its place.
_JITTER_M = 0.05


def change_room(seed: int, free_places: bool = False) -> tuple[Room, Room, dict[str, list[str]]]:
    """Return the room before and after changes, and the names of the changed objects."""
    whole = make_room(SEED, _COUNTS)
    before = replace(whole, objects=tuple(o for o in whole.objects if o.in_map))
    others = [o for o in whole.objects if not o.in_map]
    rng = np.random.default_rng(seed)
    later = move_objects(before, _MOVED, seed)
    moved = [o.name for o in later.objects if o.moved]
    staying = [o.name for o in later.objects if not o.moved]
    removed = [str(name) for name in rng.choice(staying, _REMOVED, replace=False)]
    new = [others[int(row)] for row in rng.choice(len(others), _NEW, replace=False)]
    if free_places:
        later = _move_to_free_places(before, moved, seed)
    after = replace(later, objects=tuple(
        [o for o in later.objects if o.name not in removed] + new))
    return before, after, {'moved': moved, 'removed': removed, 'new': [o.name for o in new]}


def _move_to_free_places(room: Room, moved: list[str], seed: int) -> Room:
    """Move objects to free places of the room."""
    rng = np.random.default_rng(seed)
    taken = np.array([o.slot.position for o in make_room(SEED, _COUNTS).objects])
    free = [slot for slot in find_places(SEED)
            if np.linalg.norm(taken - slot.position, axis=1).min() > _JITTER_M]
    slots = iter(rng.permutation(len(free)))
    return replace(room, objects=tuple(
        replace(item, slot=free[next(slots)], moved=True) if item.name in moved else item
        for item in room.objects))


def round_walk(count: int, start: float, height_m: float) -> npt.NDArray[np.float64]:
    """Return a walk around the room and back, which looks ahead and sees two sides of each object.

    Parameters
    ----------
    count : int
        Number of poses.
    start : float
        Angle at which the walk starts [rad].
    height_m : float
        Height of the camera [m].
    """
    loops = []
    for sign, poses in ((1.0, count // 2), (-1.0, count - count // 2)):
        turn = start + sign * np.linspace(0.0, 2.0 * np.pi, 13)
        ahead = turn + 1.1 * sign
        eyes = np.c_[3.0 + 1.2 * np.cos(turn), 2.5 + 0.9 * np.sin(turn),
                     height_m + 0.1 * np.sin(2.0 * turn)]
        gazes = np.c_[3.0 + 3.1 * np.cos(ahead), 2.5 + 2.5 * np.sin(ahead),
                      0.95 - 0.15 * np.sin(3.0 * ahead)]
        loops.append(walk(poses, eyes, gazes))
    return np.concatenate(loops)


def make_changed_room(folder: Path, images: int, seed: int, free_places: bool = False) -> None:
    """Write the walks, the map and the changes to a folder."""
    before, after, changes = change_room(seed, free_places)
    folder.mkdir(parents=True, exist_ok=True)
    write_true_map(folder / 'map.yaml', before)
    write_true_map(folder / 'map_after.yaml', replace(
        after, objects=tuple(replace(o, in_map=True) for o in after.objects)))
    (folder / 'changes.json').write_text(json.dumps(changes, indent=1))
    for number, (name, room, light, poses) in enumerate((
            ('before', before, FIRST_LIGHT, round_walk(images, 0.0, 1.45)),
            ('after', after, LATER_LIGHT, round_walk(images, 0.7, 1.3)))):
        record(folder / name, room, Renderer(room, CAMERA, light), poses, seed=seed + 5 + number,
               rate_hz=2.0)


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog='make_changed_room', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('folder', type=Path, metavar='DIR')
    parser.add_argument('--images', type=int, default=80, help='images of each walk (%(default)s)')
    parser.add_argument('--seed', type=int, default=SEED + 1, help='(%(default)s)')
    parser.add_argument('--free-places', action='store_true',
                        help='move objects to empty places instead of swapping them')
    options = parser.parse_args()
    make_changed_room(options.folder, options.images, options.seed, options.free_places)


if __name__ == '__main__':
    main()
