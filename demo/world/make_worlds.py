# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Make worlds for training: ``python -m demo.world.make_worlds DIR --count 100``."""

import argparse
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from cliploc_ros.files.parallel import run_tasks
from demo.world.recording import record, write_true_map
from demo.world.renderer import Light, Renderer
from demo.world.room import make_room
from demo.world.trajectories import CAMERA, draw_views


def make_world(folder: Path, seed: int, frames: int) -> None:
    """Render one world from random views and write it as a TUM folder, unless it exists."""
    if (folder / 'map.yaml').exists():  # written last
        return
    rng = np.random.default_rng(seed)
    room = make_room(seed)
    renderer = Renderer(room, CAMERA, Light.draw(rng))
    record(folder, room, renderer, draw_views(room, frames, rng), seed=seed)
    write_true_map(folder / 'map.yaml', room)


def main() -> None:
    """Make worlds in parallel, each with a different seed."""
    parser = argparse.ArgumentParser(prog='make_worlds', description=__doc__)
    parser.add_argument('folder', type=Path, metavar='DIR')
    parser.add_argument('--count', type=int, default=90, help='number of worlds (%(default)s)')
    parser.add_argument('--frames', type=int, default=10,
                        help='images of each world (%(default)s)')
    parser.add_argument('--seed', type=int, default=1000,
                        help='seed of the first world (%(default)s)')
    parser.add_argument('--jobs', type=int, default=os.cpu_count(),
                        help='parallel processes (%(default)s)')
    options = parser.parse_args()
    for _ in tqdm(run_tasks(
            partial(_make_work, options.folder, options.seed, options.frames),
            range(options.count), workers=options.jobs), total=options.count, unit='world'):
        pass


def _make_work(folder: Path, seed: int, frames: int) -> Callable[[int], bool]:
    def work(number: int) -> bool:
        make_world(folder / f'world_{number:03d}', seed + number, frames)
        return True

    return work


if __name__ == '__main__':
    main()
