# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Make the world of the demo: ``python -m demo.world.make_demo_world DIR``.

No model was trained on this room. The true map comes from the true boxes of a walk around its
centre. The mapping walk provides the images to build a map from. Then some objects move, the light
changes, and other walks provide the images of the wake-ups, for one camera and for four.
"""

import argparse
import json
from pathlib import Path

from scipy.spatial.transform import Rotation

from demo.world.appearance import CLASSES
from demo.world.recording import record, write_fitted_map
from demo.world.renderer import FIRST_LIGHT, LATER_LIGHT, Renderer
from demo.world.room import Room, make_room, move_objects
from demo.world.trajectories import (
    CAMERA,
    mapping_walk,
    query_walk,
    rig_mounts,
    rig_walk,
    true_map_walk,
)

#: Seed of the demo's room; the seeds of the training worlds start at 1000.
SEED = 7


def make_demo_world(folder: Path, images: int, mapping_images: int, seed: int = SEED) -> None:
    """Write the true map (map.yaml), the mapping walk (mapping/) and the wake-ups (sequence/)."""
    room = make_room(seed, dict.fromkeys(CLASSES, 8))
    renderer = Renderer(room, CAMERA, FIRST_LIGHT)
    folder.mkdir(parents=True, exist_ok=True)
    write_fitted_map(folder / 'map.yaml', room, renderer, true_map_walk(120), seed=seed)
    record(folder / 'mapping', room, renderer, mapping_walk(mapping_images), seed=seed + 5)
    later = move_objects(room, 4, seed + 1)
    record(folder / 'sequence', later, Renderer(later, CAMERA, LATER_LIGHT), query_walk(images),
           seed=seed + 2, rate_hz=2.0)
    make_rig(folder / 'rig', later, seed + 3)


def make_rig(folder: Path, room: Room, seed: int) -> None:
    """Write a walk for each camera of a rig (NAME/), and the cameras' mounts (mounts.json)."""
    mounts, poses = rig_mounts(), rig_walk()
    renderer = Renderer(room, CAMERA, LATER_LIGHT)
    for number, (name, mount) in enumerate(mounts.items()):
        record(folder / name, room, renderer, poses @ mount, seed=seed + number)
    (folder / 'mounts.json').write_text(json.dumps({name: [
        *mount[:3, 3], *Rotation.from_matrix(mount[:3, :3]).as_quat()]
        for name, mount in mounts.items()}))


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog='make_demo_world', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('folder', type=Path, metavar='DIR')
    parser.add_argument('--images', type=int, default=48,
                        help='images of the wake-ups (%(default)s)')
    parser.add_argument('--mapping-images', type=int, default=30,
                        help='images of the mapping walk (%(default)s)')
    parser.add_argument('--seed', type=int, default=SEED)
    options = parser.parse_args()
    make_demo_world(options.folder, options.images, options.mapping_images, options.seed)


if __name__ == '__main__':
    main()
